"""The whole loop on a simulated arm, from a plan to the missing effect: one planar arm, one with six axes."""
