"""Tuning of hybrid controllers by gradients through whole swing-ups."""
