"""Figures and the report page. The only layer that imports matplotlib."""

ANIMATION_FORMATS = ("gif", "mp4", "html")
"""Here, where the command line can read it without importing matplotlib."""
