"""The work folder and this machine: files, databases, locks, errors, streams; nothing about studies or runs."""
