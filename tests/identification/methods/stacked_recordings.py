"""The model of recordings that are at hand, as a fit makes them of its recordings."""

from identification.data import Recordings
from identification.methods import Model
from identification.methods.model import model_of
from identification.regression import Overrides, Problem


def system_of(*problems: Problem) -> Model:
    sources = tuple(problem.signals for problem in problems)
    return model_of(Recordings(sources=sources), Overrides(), problems, tuple(range(len(problems))))
