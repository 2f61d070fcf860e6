"""Tables, charts and a page from result files. Nothing here trains, renders or imports torch; every number comes from a
`result.json`, from the log beside it, or from the file of published numbers.

A table is a function `build(results, request) -> Table`, an entry of `reports.gathered.TABLES`; writers turn any
`Table` into text. What can be asked for is an entry of `REPORTS`: a function that yields files.
"""

REPORTS = {
    "table1": "reports.files:table1",
    "table2": "reports.files:table2",
    "table3": "reports.files:table3",
    "table4": "reports.files:table4",
    "methods": "reports.files:methods",
    "equal_time": "reports.files:equal_time",
    "ladder": "reports.files:ladder",
    "quirks": "reports.files:quirks",
    "runs": "reports.files:runs",
    "sweep": "reports.files:sweep",
    "chart": "reports.files:chart",
    "html": "reports.files:html",
}
