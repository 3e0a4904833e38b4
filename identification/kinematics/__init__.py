"""Kinematics of arms and the parameters of their geometry."""
