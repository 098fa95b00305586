"""Trade-offs between settling time and what it costs: fronts of controllers."""
