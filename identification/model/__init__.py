"""The model of an arm with its effects, and the arm's place and minimal parameters where its file leaves them open."""

from identification.model.arm_model import Model

__all__ = ["Model"]
