"""Conversions of cpjax's plants and controllers for other packages; each bridge is imported only on request."""
