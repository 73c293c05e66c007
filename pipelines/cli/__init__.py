"""The command `rhmc`, a module for each noun; a verb imports what does the work, and turns the outcome into an exit code."""
