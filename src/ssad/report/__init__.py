"""Tables, figures and pages from the records of a run, for every kind of experiment.

Reads records, traces and baked towns only: a report is rebuilt without the world.
"""

from ssad.report.artefacts import check_artefacts as check_artefacts
from ssad.report.video import write_video as write_video
