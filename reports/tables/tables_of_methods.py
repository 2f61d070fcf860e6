"""Tables 1, 2 and 4 of the paper: quality indoors, quality outdoors, and what it costs."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports.conditions import OF_TIMES
from reports.measures import COSTS, GPU_MEMORY, marks, on_gpu
from reports.request import Request
from reports.scenes import Place
from reports.tables.comparison import Comparison
from reports.tables.ranking import NOTE
from reports.tables.table import Table


def table1(results: Sequence[Result], request: Request) -> Table:
    """Quality on 360Roam and on other indoor scenes."""
    title = "Quality on the 11 indoor scenes of 360Roam, and on other indoor scenes"
    indoor = Comparison("table1", title, marks(request.protocol), {"roam360": 1}, _indoor, notes=(NOTE,))
    return indoor.build(results, request)


def table2(results: Sequence[Result], request: Request) -> Table:
    """Quality on Ricoh360 and on other outdoor scenes."""
    title = "Quality on the 12 outdoor scenes of Ricoh360, and on other outdoor scenes"
    outdoor = Comparison("table2", title, marks(request.protocol), {"ricoh360": 2}, _outdoor, notes=(NOTE,))
    return outdoor.build(results, request)


def table4(results: Sequence[Result], request: Request) -> Table:
    """Training time, rendering speed, size and memory."""
    marks(request.protocol)  # an unknown one is refused here too
    datasets = {"roam360": 4, "ricoh360": 4}
    costs, notes = tuple(COSTS), (NOTE, *_HOW_MEASURED)
    if on_gpu(results):
        costs, notes = (*costs, GPU_MEMORY), (*notes, "Memory of the GPU: peak of the tensors there while training.")
    efficiency = Comparison("table4", "Efficiency", costs, datasets, _any, OF_TIMES, notes)
    return efficiency.build(results, request)


_HOW_MEASURED = (
    "Time per frame: median over the test views, decoding included. Memory: peak of the process while training.",
)


def _indoor(place: Place) -> bool:
    return not place.outdoor


def _outdoor(place: Place) -> bool:
    return place.outdoor


def _any(place: Place) -> bool:
    return True
