"""Camera poses of a moving scope from its pictures."""
