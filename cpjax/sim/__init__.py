"""The loop: integrators, the closed-loop step, rollouts, metrics and sweeps."""
