"""Every test runs in float64 with strict dtype promotion; what is about float32 asks for it by name."""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
