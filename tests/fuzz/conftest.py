import pytest


@pytest.fixture(scope="session")
def share(full):
    """How many of the inputs are run: all of them with --full, else as many as a minute allows."""
    return lambda whole, part: whole if full else part
