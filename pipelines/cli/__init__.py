"""The command `rhmc`, a module for each noun; no work is done here, a verb makes an exit code of what others do."""
