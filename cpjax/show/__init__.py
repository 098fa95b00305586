"""Figures and the report page. The only room that imports matplotlib."""
