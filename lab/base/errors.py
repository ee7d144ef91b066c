"""The root of chordlab's errors.

A message is one line that says what is wrong and how to mend it; the commands print it without a
traceback. Each package derives narrow errors that carry their data as attributes.
"""


class ChordlabError(Exception):
    """Root of everything that chordlab raises on purpose. As a command's end: exit code 1."""

    exit_code = 1


class RequestError(ChordlabError):
    """What was asked for cannot be done as asked: a bad shape, setting or file. Exit code 2."""

    exit_code = 2
