"""Fronts of controllers that trade settling time against effort, cart travel or voltage variation."""
