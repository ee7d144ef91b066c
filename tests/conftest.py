import pytest


def pytest_addoption(parser):
    parser.addoption("--full", action="store_true", help="run the long proofs (-m slow) with all their sessions")


def pytest_collection_modifyitems(config, items):
    """In part, a long proof that is given for several cases is run for its first alone."""
    if config.getoption("--full"):
        return
    seen = set()
    for item in items:
        if item.get_closest_marker("slow"):
            proof = item.nodeid.partition("[")[0]
            if proof in seen:
                item.add_marker(pytest.mark.skip(reason="run with --full"))
            seen.add(proof)


@pytest.fixture(scope="session")
def full(request):
    """Whether the long proofs are to be run in full; else they are scaled down to fit into minutes."""
    return request.config.getoption("--full")


@pytest.fixture(scope="session", autouse=True)
def _no_cache_but_our_own(tmp_path_factory):
    """What tests learn is kept for the run alone; the user's cache is neither read nor written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CHORDLAB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
