"""Tables from result files. Nothing here trains, renders or imports torch; every number comes from a `result.json`
or from the file of published numbers.

A table is a function `build(results, request) -> Table`, an entry of `TABLES`; writers turn any `Table` into text.
"""

TABLES = {
    "table3": "reports.table3:build",
    "runs": "reports.runs:build",
}
WRITERS = {  # file extension -> Table -> text
    "md": "reports.markdown:text",
    "tex": "reports.latex:text",
}
