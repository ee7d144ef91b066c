import pytest


@pytest.fixture(scope="session", autouse=True)
def _no_cache_but_our_own(tmp_path_factory):
    """What tests learn is kept for the run alone; the user's cache is neither read nor written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CHORDLAB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
