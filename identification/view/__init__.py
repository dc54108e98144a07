"""Views of recordings, fits and studies, as Rerun files or HTML.

It owns what a view shows, as plain data (`panels`), and the renderers that draw it; it alone
imports rerun. It may use every subpackage below `commands`, and makes no fits itself. Only
`commands` and the notebook use it.
"""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

from .html_page import Figures, notebook_figures, write_html
from .pages import (
    draw_comparison,
    draw_excitation,
    draw_fit,
    draw_friction,
    draw_recording,
    draw_sensitivity,
    draw_study,
    draw_validation,
    join_pictures,
)
from .panels import Picture

if TYPE_CHECKING:
    from .live import follow_recording
    from .rerun_panels import write_rrd
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "rerun_panels": ("write_rrd",),
            "live": ("follow_recording",),
        },
    )
