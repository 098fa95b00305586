"""Differentiable design of gains for linear models, and analysis of the resulting loops."""
