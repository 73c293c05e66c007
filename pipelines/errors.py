"""What a user can mend. Imports nothing, so that the command line can catch it before anything heavy is loaded."""


class InputError(Exception):
    """What was given cannot be used; the text is the whole message, meant for a person. Exit code 2."""
