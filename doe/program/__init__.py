"""Programs with which a controller drives through a plan."""
