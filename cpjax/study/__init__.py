"""Studies computed from many rollouts: basins, gradient audits, design checks and trade-off fronts."""
