"""Code whose only purpose is speed with XLA's CPU compiler; it changes results in their last bits at most.

docs/performance.md describes each part and its effect.
"""
