"""cpjax's plants and controllers in the terms of other packages; each bridge is imported by whoever wants it."""
