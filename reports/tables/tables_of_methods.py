"""Tables 1, 2 and 4 of the paper: quality indoors, quality outdoors, and what it costs."""

from __future__ import annotations

from padgs.reports.conditions import OF_TIMES
from padgs.reports.gathered import Gathered
from padgs.reports.measures import costs, gpu_memory, marks
from padgs.reports.tables.comparison import Comparison
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Table


def table1(gathered: Gathered) -> Table:
    """Quality on 360Roam and on other indoor scenes."""
    title = "Quality on the 11 indoor scenes of 360Roam, and on other indoor scenes"
    measures = marks(gathered.request.protocol)
    indoor = Comparison("table1", title, measures, {"roam360": 1}, lambda place: not place.outdoor, notes=(NOTE,))
    return indoor.build(gathered)


def table2(gathered: Gathered) -> Table:
    """Quality on Ricoh360 and on other outdoor scenes."""
    title = "Quality on the 12 outdoor scenes of Ricoh360, and on other outdoor scenes"
    measures = marks(gathered.request.protocol)
    outdoor = Comparison("table2", title, measures, {"ricoh360": 2}, lambda place: place.outdoor, notes=(NOTE,))
    return outdoor.build(gathered)


def table4(gathered: Gathered) -> Table:
    """Training time, rendering speed, size and memory."""
    gpu = gpu_memory(gathered.runs)
    measures = costs("train_hours", "fps", "frame_ms", "gaussians", "megabytes", "peak_gigabytes")
    notes = (NOTE, *_HOW_MEASURED, *(_HOW_MEASURED_ON_A_GPU if gpu else ()))
    datasets = {"roam360": 4, "ricoh360": 4}
    efficiency = Comparison("table4", "Efficiency", (*measures, *gpu), datasets, lambda place: True, OF_TIMES, notes)
    return efficiency.build(gathered)


_HOW_MEASURED = (
    "Time per frame: median over the test views, decoding included. Memory: peak of the process while training.",
)
_HOW_MEASURED_ON_A_GPU = ("Memory of the GPU: peak of the tensors there while training.",)
