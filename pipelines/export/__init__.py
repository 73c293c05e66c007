"""Tables and JSON files for the report, from the log and from the code; no statistics and no figures."""
