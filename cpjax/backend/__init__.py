"""All that exists only to make XLA's compiler for CPUs fast; results do not depend on it but in their last bits.

Each part, its measured gain, its cause and how to switch it off: docs/performance.md.
"""
