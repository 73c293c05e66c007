"""The command `rhmc`, a module for each noun; no work is done here, a verb imports what does it."""
