"""What tests of a fit say: a table of their words, each with the figures that it takes."""

WORDS = {
    "excitation": "a combination of parameters, mostly {names}, is hardly excited: condition "
    "number {condition:.3g}, limit {limit:g}: record a more varied motion, as `robot-identify "
    "excite` designs one",
    "excited": "condition number {condition:.3g} of the essential parameters (limit {limit:g})",
    "lag not measured": "{known}: state effort_timing, or take --method iv, which measures it",
    "lag not shown": "{known}: state effort_timing, or record longer moves: joints reverse too "
    "often for their rows to show it",
    "lag assumed": "{known}: no reference is recorded that would show it; state effort_timing",
    "why lag assumed": "no reference is recorded that would show it: {cost}",
    "wrong sign": "{joints}: effort or position has the wrong sign",
    "links lost": "{text}: the efforts lack the links' torque (an external torque, noise, or a "
    "dead channel), or it is another robot's prior?",
    "links lost, in short": "the efforts lack the links' torque",
    "zero off": "zero of joint {joint} off by {deg} deg",
    "gravity": "gravity along {sign}{axis} of the base (gravity_m_s2)",
    "far": "{text}; far from a physical robot, and {witness}",
    "cause": "{text}: {cause}?",
}
