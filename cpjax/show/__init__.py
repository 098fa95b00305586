"""Figures and the report page. The only layer that imports matplotlib."""
