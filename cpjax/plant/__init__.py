"""Plant layer: the state and its conventions, cart-pole and motor, the linear model, initial states."""

from cpjax.plant.cartpole import CartPole
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.linearization import LinearModel, linearize
from cpjax.plant.motor import AccelerationActuator, ForceActuator, LumpedMotor, Motor
from cpjax.plant.parameters import parameter, parameters_of, with_parameters
from cpjax.plant.state import HANGING, UPRIGHT, State

__all__ = [
    "HANGING",
    "UPRIGHT",
    "AccelerationActuator",
    "CartPole",
    "ForceActuator",
    "LinearModel",
    "LumpedMotor",
    "Motor",
    "State",
    "linearize",
    "parameter",
    "parameters_of",
    "sample_starts",
    "with_parameters",
]
