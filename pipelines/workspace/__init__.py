"""The work folder and this machine: files, databases, locks, errors, streams. Nothing about studies or runs."""
