"""Pictures of recordings, fits and studies, as Rerun files or HTML.

The only room that imports rerun, to write its files.
"""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

from .charts import deviation_charts as deviation_charts
from .pages import draw_comparison as draw_comparison
from .pages import draw_excitation as draw_excitation
from .pages import draw_fit as draw_fit
from .pages import draw_friction as draw_friction
from .pages import draw_recording as draw_recording
from .pages import draw_sensitivity as draw_sensitivity
from .pages import draw_study as draw_study
from .pages import draw_validation as draw_validation
from .pages import join_pictures as join_pictures
from .panels import Picture as Picture

if TYPE_CHECKING:
    from .html_page import notebook_figure as notebook_figure
    from .html_page import write_html as write_html
    from .live import follow_recording as follow_recording
    from .rerun_panels import write_rrd as write_rrd
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "rerun_panels": ("write_rrd",),
            "html_page": ("notebook_figure", "write_html"),
            "live": ("follow_recording",),
        },
    )
