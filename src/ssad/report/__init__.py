"""From the records of a run to tables, a self-contained HTML page with replays, and videos.

Reads records, traces and baked towns only: a report is rebuilt without the world.
"""

from ssad.report.artefacts import check_artefacts as check_artefacts
from ssad.report.pages import write_report as write_report
from ssad.report.video import write_video as write_video
