"""Success of the paper's controllers, held against an independent implementation's counts.

    python experiments/success_table.py

That implementation was made before this project and shares no code with it; its rates over 512 other starts of the same
set are `REFERENCE`. Each row is confirmed unless a two-proportion test at 99.9 % says that the two rates differ.
"""

import dataclasses
from pathlib import Path
from typing import Any

from _common import run

from cpjax import files
from cpjax.numeric.statistics import two_proportion_p_value
from cpjax.paper import Design
from cpjax.paper.reproduction import EvaluationConfig, Variant, evaluate
from cpjax.show.figures import save_figure, success_rates
from cpjax.study.summary import summarise

REFERENCE_COUNT = 512
REFERENCE: dict[tuple[str, str, Design], float] = {
    ("as-printed", "appendix", "placement"): 0.176,
    ("as-printed", "appendix", "lqr"): 0.100,
    ("as-printed", "identified", "placement"): 0.230,
    ("as-printed", "identified", "lqr"): 0.082,
    ("corrected", "appendix", "placement"): 0.242,
    ("corrected", "appendix", "lqr"): 0.102,
    ("corrected-as-voltage", "appendix", "placement"): 0.0,
    ("corrected-as-voltage", "appendix", "lqr"): 0.0,
    ("corrected-as-voltage", "identified", "placement"): 0.0,
    ("corrected-as-voltage", "identified", "lqr"): 0.0,
    ("corrected-centred", "appendix", "placement"): 1.0,
    ("corrected-centred", "appendix", "lqr"): 0.650,
}
"""Law, plant, regulator with its printed gain: share of starts that settled."""


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes success_table.json and success_table.png."""
    setting = EvaluationConfig(count=64 if quick else 4096, seed=seed)
    rows = []
    for (law, plant, design), reference in REFERENCE.items():
        row = summarise(evaluate(Variant(law, plant, design, "printed"), setting))
        p = two_proportion_p_value(row["successes"], row["count"], round(reference * REFERENCE_COUNT), REFERENCE_COUNT)
        names = {"law": law, "plant": plant, "design": design, "gains": "printed"}
        rows.append({**names, **row, "reference_rate": reference, "p_value": p, "confirmed": p >= 1e-3})
        low, high = row["success_interval"]
        print(
            f"{law:21} {plant:10} {design:9} {100 * row['success_rate']:6.2f} % ({100 * low:5.2f} to {100 * high:6.2f})"
            f"   reference {100 * reference:5.1f} %   p = {p:.3f}   {'confirmed' if p >= 1e-3 else 'REFUTED'}",
            flush=True,
        )
        document = {"versions": files.versions(), "setting": dataclasses.asdict(setting), "rows": rows}
        files.write_json(out / "success_table.json", document)
    save_figure(out / "success_table.png", success_rates(rows))
    return rows


if __name__ == "__main__":
    run(main, __doc__ or "")
