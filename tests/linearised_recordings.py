"""The linearised regression of recordings that are at hand, as a fit makes it of its recordings."""

from identification.regression import Linearised, Place, Problem, Regression, own_parameters, regression_of_recording


def linearised_of(*problems: Problem, plain: Regression | None = None) -> Linearised:
    """Of the problems of recordings; `plain` is the regression of a lone one where it is made already."""
    return Linearised(
        problem=problems[0],
        each=tuple(regression_of_recording(problem) for problem in problems) if plain is None else (plain,),
        places=tuple(Place.of(problem) for problem in problems),
        parameters=own_parameters(problems),
    )
