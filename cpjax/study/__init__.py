"""Questions asked of many rollouts."""
