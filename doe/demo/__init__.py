"""The whole loop on a simulated arm, from a plan to the missing effect: one of the plane, one of six axes."""
