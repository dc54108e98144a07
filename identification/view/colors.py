"""Colors of curves and marks: the same meaning on all pages."""

Color = tuple[int, int, int]

# Okabe and Ito's colors, distinguishable for the color-blind (Color Universal Design, 2008), on
# dark and light background.
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)
GREY, LIGHT = (140, 140, 140), (205, 205, 205)
MEASURED, REFERENCE, SIMULATED, PREDICTED, RESIDUAL = GREY, GREEN, SKY, ORANGE, VERMILLION
JOINTS = (SKY, ORANGE, GREEN, VERMILLION, PURPLE, YELLOW, BLUE, GREY)  # in turn
COMPARED = (PURPLE, GREEN)  # the parameter sets that a fit is compared with
CLASSES: dict[Color, str] = {  # of the style sheet, which has a shade of each for light and dark
    ORANGE: "orange", SKY: "sky", GREEN: "green", YELLOW: "yellow", BLUE: "blue",
    VERMILLION: "vermillion",
    PURPLE: "purple", GREY: "grey", LIGHT: "light",
}  # fmt: skip
