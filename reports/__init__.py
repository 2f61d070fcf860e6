"""Tables from result files. Nothing here trains, renders or imports torch; every number comes from a `result.json`
or from the file of published numbers.

A table is a function `build(results, request) -> Table`, an entry of `TABLES`; writers turn any `Table` into text.
"""

TABLES = {
    "table1": "reports.tables_of_methods:table1",
    "table2": "reports.tables_of_methods:table2",
    "table3": "reports.table3:build",
    "table4": "reports.tables_of_methods:table4",
    "runs": "reports.runs:build",
}
WRITERS = {  # file extension -> Table -> text
    "md": "reports.markdown:text",
    "tex": "reports.latex:text",
    "csv": "reports.csv_text:text",
}
