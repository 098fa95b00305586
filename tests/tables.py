"""Tables of cases that one test goes through."""

import functools
import inspect

import pytest


def rows(names, table, ids=None):
    """Makes of a test function one test that goes through a table, and says of each row that fails why.

    Takes what `pytest.mark.parametrize` takes, which makes a test of each row. That is for rows that take long, or that
    are questions of their own; this is for tables of inputs that one rule is to treat alike.

    Args:
      names: of the arguments that a row gives, as a tuple or as a text with commas.
      table: rows; of a single name, its values.
      ids: names of the rows in what a failure says: a list, or a function of a value; by default the row.
    """
    names = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)

    def decorate(test):
        @functools.wraps(test)
        def over_all_rows(*self, **fixtures):
            failures, folder = [], fixtures.get("tmp_path")
            for number, row in enumerate(table):
                values = row.values if hasattr(row, "marks") else row if len(names) > 1 else (row,)
                if folder is not None:  # each row has one of its own
                    fixtures["tmp_path"] = folder / str(number)
                    fixtures["tmp_path"].mkdir()
                try:
                    test(*self, **dict(zip(names, values, strict=True)), **fixtures)
                except (Exception, pytest.fail.Exception) as problem:
                    row_name = ids[number] if isinstance(ids, (list, tuple)) else f"{row!r}"[:200]
                    failures.append(f"{row_name}: {type(problem).__name__}: {problem}")
            assert not failures, f"{len(failures)} of {number + 1} rows fail:\n" + "\n".join(failures)

        rest = [p for p in inspect.signature(test).parameters.values() if p.name not in names]
        over_all_rows.__signature__ = inspect.Signature(rest)
        del over_all_rows.__wrapped__
        return over_all_rows

    return decorate
