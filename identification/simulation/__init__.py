"""The robot in closed loop: control laws, friction with stick phases, integration."""

from .loop import Friction, Loop, has_controller, recorded_loop, simulate, surrogate_loop

__all__ = ["Friction", "Loop", "has_controller", "recorded_loop", "simulate", "surrogate_loop"]
