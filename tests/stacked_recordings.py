"""The system of recordings that are at hand, as a fit makes it of its recordings."""

from dataclasses import replace

from identification.data import Recordings
from identification.methods import StackedSystem
from identification.methods.observation import observation_of
from identification.methods.system import stack_recordings
from identification.regression import Overrides, Problem, Regression


def system_of(*problems: Problem, plain: Regression | None = None) -> StackedSystem:
    """Of the problems of recordings; `plain` is the regression of a lone one where it is made already."""
    observations = [observation_of(problem, 1) for problem in problems]
    if plain is not None:
        observations = [replace(observations[0], regression=plain)]
    sources = tuple(problem.signals for problem in problems)
    return stack_recordings(Recordings(sources=sources), Overrides(), observations, tuple(range(len(problems))))
