"""The command `rhmc`, a module for each noun; a verb imports what works, and makes an exit code of the outcome."""
