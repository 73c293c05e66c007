"""The verbs of the command line, a module for each noun. What is heavy is imported by the verb that needs it."""
