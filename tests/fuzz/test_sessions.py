"""Stored sessions by a stranger's hand: every reader answers, or refuses in one line."""

import json
import shutil

import numpy as np
import pytest

from lab.batch.rows import row_of
from lab.reopen.stored import stored_settings, stored_shape
from lab.review.review import examine
from lab.session.tally import stored_estimate
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.fuzz.harness import fuzz, is_refused
from tests.fuzz.mutate import hostile, mangled, mutated, pick
from tests.fuzz.mutate import to_json as broken_json
from tests.lab.conftest import roll


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A session of a few lines over the square, no video."""
    return roll(tmp_path_factory.mktemp("whole"), shape="square", stop__lines=8, seed=5).folder


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """The same of two robots."""
    robots = ["virtual", "virtual"]
    return roll(tmp_path_factory.mktemp("several"), shape="square", stop__lines=8, seed=5, robot=robots).folder


class Session:
    """A stored session that is broken anew for each input."""

    def __init__(self, whole, folder):
        self.folder = folder
        shutil.copytree(whole, folder)
        self.manifest_bytes = (whole / "manifest.json").read_bytes()
        self.log_bytes = (whole / "events.jsonl").read_bytes()
        self.manifest = json.loads(self.manifest_bytes)
        self.events = [json.loads(row) for row in self.log_bytes.splitlines()]

    def broken(self, rng):
        """The bytes of manifest and log, one or both broken."""
        manifest, log = self.manifest_bytes, self.log_bytes
        way = int(rng.integers(8))
        if way in (0, 4):
            manifest = mangled(manifest, rng, (log,))
        elif way in (1, 2, 3):
            # the geometry and the settings are where most of the manifest's places are
            part = pick(rng, list(self.manifest))
            tree = mutated(self.manifest, rng) if rng.random() < 0.4 else self.manifest | {part: self._part(part, rng)}
            manifest = broken_json(tree, rng)
        if way in (4, 5):
            log = mangled(log, rng, (manifest,))
        elif way in (3, 6, 7):
            events = list(self.events)
            for _ in range(int(rng.integers(1, 4))):
                number = int(rng.integers(len(events)))
                match int(rng.integers(6)):
                    case 0:
                        events[number : number + 1] = []
                    case 1:
                        events.insert(number, events[int(rng.integers(len(events)))])
                    case _:
                        events[number] = mutated(events[number], rng, most=2)
                if not events:
                    break
            log = b"".join(broken_json(event, rng) + b"\n" for event in events)
        return manifest, log

    def _part(self, part, rng):
        value = self.manifest[part]
        return mutated(value, rng, most=2) if isinstance(value, (dict, list)) and value else hostile(rng)

    def write(self, given):
        manifest, log = given
        (self.folder / "manifest.json").write_bytes(manifest)
        (self.folder / "events.jsonl").write_bytes(log)


@pytest.fixture(params=["whole", "several"])
def session(request, tmp_path):
    return Session(request.getfixturevalue(request.param), tmp_path / "session")


def read_cheaply(folder):
    session = SessionReader(folder)
    tables = tables_of(session)
    session.segments()
    stored_estimate(tables.lines, tables.crossings)
    settings, shape = stored_settings(session), stored_shape(session)
    settings.profile()
    settings.true_optics()
    assert np.isfinite(settings.arena.longest_line_cm)
    assert shape.digest


@pytest.mark.timeout(1800)
def test_manifest_and_log(share, session):
    def read(given):
        session.write(given)
        read_cheaply(session.folder)

    fuzz(f"manifest and log, {len(session.events)} events", share(8_000, 100), session.broken, read)


@pytest.mark.timeout(3600)
def test_whole_review(share, session):
    """Sessions that pass the cheap readers, as far as a few attempts give one, are examined whole."""

    def broken(rng):
        for _ in range(6):
            given = session.broken(rng)
            session.write(given)
            if not is_refused(read_cheaply, session.folder):
                break
        return given

    def read(given):
        session.write(given)
        examine(session.folder)

    fuzz(f"examine, {len(session.events)} events", share(150, 2), broken, read)


@pytest.mark.timeout(3600)
def test_rows_of_a_batch(share, session):
    """A batch makes a row of every folder, whatever is in it; the row says in one line why there are no figures."""

    def read(given):
        session.write(given)
        found = row_of(session.folder)
        assert all(len(str(value).splitlines()) <= 1 for value in found.values())

    fuzz("row_of", share(150, 2), session.broken, read)
