"""What is known of a run without torch: its result and the file of it, what lies beside that, and what decided it.

Standard library only, so that reports need nothing else.
"""

from padgs.results.deciding import DECIDE_NOTHING, OF_THE_MACHINE, decisive
from padgs.results.file import (
    FILE_NAME,
    ResultError,
    decoded,
    encoded,
    file_content,
    parsed,
    read,
    read_all,
    write,
)
from padgs.results.folder import CONFIG_NAME, LOG_NAME, NEED_PICTURE, PICTURES, file_name, log_lines, picture_name
from padgs.results.result import (
    ASKED,
    BY_ITSELF,
    NEED_LOSSES,
    NEED_PICTURED,
    NEED_STATED,
    STATUSES,
    Result,
    Scores,
    higher_is_better,
    joined,
)

__all__ = [
    "ASKED",
    "BY_ITSELF",
    "CONFIG_NAME",
    "DECIDE_NOTHING",
    "FILE_NAME",
    "LOG_NAME",
    "NEED_LOSSES",
    "NEED_PICTURE",
    "NEED_PICTURED",
    "NEED_STATED",
    "OF_THE_MACHINE",
    "PICTURES",
    "STATUSES",
    "Result",
    "ResultError",
    "Scores",
    "decisive",
    "decoded",
    "encoded",
    "file_content",
    "file_name",
    "higher_is_better",
    "joined",
    "log_lines",
    "parsed",
    "picture_name",
    "read",
    "read_all",
    "write",
]
