"""The command `rhmc`: a module for each noun. A verb imports what is heavy itself."""
