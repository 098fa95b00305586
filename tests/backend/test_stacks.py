"""What a loop stores for reverse mode, with the compiler's options; in a process that has not started JAX."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

import cpjax
from cpjax.backend import runtime, stacks

SCRIPT = """
import json, re, sys
import cpjax
from cpjax.backend import stacks
cpjax.configure_cpu(1)
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
if sys.argv[1] == "joined":
    stacks.runtime.compiler_fuses_loops = lambda: False
plant, law = cpjax.CartPole(), cpjax.preset("lqr")

def cost(law, start):
    settings = dict(duration=0.4, dt=0.01, metrics=cpjax.TimeOutside(), derivative="pathwise", checkpoint="every_step")
    return cpjax.measure(plant, law, start, **settings)

starts = jax.tree.map(jnp.asarray, cpjax.sample_starts("hanging", 64, seed=1))
gradient = jax.jit(jax.vmap(jax.value_and_grad(cost), (None, 0)))
text = gradient.lower(law, starts).compile().as_text()
writes = [body.count(" dynamic-update-slice(") for body in re.split("\\n}", text) if "fused_computation" in body]
value, slopes = gradient(law, starts)
print(json.dumps([max(writes), value.tolist(), slopes.swing_up.energy_gain.tolist()]))
"""


def in_a_process(*arguments):
    done = subprocess.run([sys.executable, "-c", SCRIPT, *arguments], check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def test_each_stack_is_written_by_a_loop_of_its_own():
    (most, *apart), (joined, *together) = in_a_process("apart"), in_a_process("joined")
    assert most == 1
    assert joined > 1  # what XLA does otherwise
    np.testing.assert_allclose(apart, together, rtol=1e-9)


def test_no_two_leaves_have_one_shape_and_all_return_to_theirs(monkeypatch):
    monkeypatch.setattr(runtime, "compiler_fuses_loops", lambda: True)
    tree = {"state": cpjax.State(*map(jnp.asarray, (1.0, 2.0, 3.0, 4.0))), "mode": jnp.asarray(1), "more": jnp.eye(2)}
    leaves = stacks.apart(tree)
    assert len({leaf.shape for leaf in leaves}) == len(leaves)
    jax.tree.map(np.testing.assert_array_equal, stacks.together(leaves, tree), tree)


def test_leaves_beyond_the_largest_rank_share_their_shape(monkeypatch):
    monkeypatch.setattr(runtime, "compiler_fuses_loops", lambda: True)
    leaves = stacks.apart([jnp.asarray(float(i)) for i in range(40)])
    assert max(leaf.ndim for leaf in leaves) == stacks.LARGEST_RANK


def test_without_such_loops_leaves_stay_as_they_are(monkeypatch):
    monkeypatch.setattr(runtime, "compiler_fuses_loops", lambda: False)
    leaves = [jnp.asarray(1.0), jnp.asarray(2.0)]
    assert [leaf.shape for leaf in stacks.apart(leaves)] == [(), ()]
