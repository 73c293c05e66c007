"""Tables and JSON files for the report, written from the log and from the code. No figures."""
