"""One whole experiment: dictionary, bench, session, store. What `chordlab run` does before the review."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import mapping

from analysis.perline import LineRecogniser
from analysis.recognition import Recogniser
from lab.base.errors import ChordlabError
from lab.bench.devices import Bench, open_bench
from lab.clock import run as run_on_clock
from lab.live.live import Live
from lab.recognise.recognisers import recogniser_for
from lab.session.ledger import Ledger, Watcher
from lab.session.levels import SessionLevels
from lab.session.listening import Listening
from lab.session.session import NOTHING_EARLIER, Earlier, Outcome, Preflight, Session
from lab.session.tally import Tally, tally_for
from lab.settings.settings import Settings
from lab.store.writer import SessionWriter, disk_faults
from projector.dictionary import load_dictionary, shape_from
from projector.shape import Shape
from robot.device import Identity

_LONG_DICTIONARY = 30  # learning fewer takes seconds
_VERSIONED = ("chordlab", "numpy", "shapely", "opencv-python-headless", "bleak", "bumble", "filterpy", "numba", "av")


@dataclass(frozen=True, slots=True)
class Finished:
    """An experiment's folder and how it ended. ``interrupted`` is true after Ctrl-C, ``failure`` holds an error."""

    folder: Path
    outcome: Outcome | None
    interrupted: bool
    failure: ChordlabError | None


@dataclass(slots=True)
class _Kept:
    """What must outlive an interrupt."""

    writer: SessionWriter | None = None
    outcome: Outcome | None = None


def dictionary_with(shape: Shape, settings: Settings) -> dict[str, Shape]:
    """The session's collection, and the projected shape too where it is none of its entries."""
    known = load_dictionary(settings.dictionary, font=settings.font)
    return known if shape.name in known else {**known, shape.name: shape}


def run_experiment(
    settings: Settings,
    *,
    started: datetime,
    watch: Watcher | None = None,
    say: Callable[[str], None] = lambda _: None,
    live: Live | None = None,
) -> Finished:
    """Run one session on the bench that the settings name and leave its folder.

    An interrupt or a failure after the folder was made is returned, not raised: the folder is readable.

    Raises:
        ChordlabError: nothing was recorded, since the request was wrong or the preflight failed.
    """
    shape = shape_from(settings.shape, font=settings.font)
    dictionary = dictionary_with(shape, settings)
    recogniser = recogniser_of(dictionary, settings, shape.name, say)

    def create(bench: Bench, preflight: Preflight) -> SessionWriter:
        manifest = _manifest(settings, shape, dictionary, bench, preflight, recogniser, started)
        tag = hashlib.sha256(str(sorted(manifest.items())).encode()).hexdigest()[:4]
        return SessionWriter.create(settings.out, shape.name, manifest, started=started, tag=tag)

    ledger, tally = Ledger(settings.stop, recogniser), tally_for(settings)
    return conduct(settings, shape, ledger, tally, create, watch=watch, say=say, live=live)


def conduct(
    settings: Settings,
    shape: Shape,
    ledger: Ledger,
    tally: Tally,
    open_folder: Callable[[Bench, Preflight], SessionWriter],
    *,
    earlier: Earlier = NOTHING_EARLIER,
    watch: Watcher | None = None,
    say: Callable[[str], None] = lambda _: None,
    live: Live | None = None,
) -> Finished:
    """Open the bench, look that all is well, open the session's folder, roll, and close all.

    Args:
        settings: the session's.
        shape: what is projected.
        ledger: what the session knows so far.
        tally: its sums.
        open_folder: makes or opens the folder, once the devices are ready.
        earlier: what the session goes on from.
        watch: told where the session stands, after each run.
        say: told in words what befalls the robots.
        live: what people ask of the session meanwhile, and are shown.

    Raises:
        ChordlabError: nothing was recorded.
    """
    live = live or Live()
    world_seed, turn_seed = settings.seeds(earlier.part)
    kept = _Kept()

    async def on_the_bench() -> None:
        on_frame = live.feed.frame if live.feed.watched else None
        async with live.attended(), open_bench(settings, shape, world_seed, on_frame=on_frame) as bench:
            session = _session(
                bench, settings, ledger, tally, turn_seed, earlier=earlier, watch=watch, say=say, live=live
            )
            preflight = await session.preflight()
            for identity, levels in zip(preflight.identities, preflight.levels, strict=True):
                say(_introduction(identity, levels))
            kept.writer = open_folder(bench, preflight)
            live.feed.tell(folder=kept.writer.folder)
            kept.outcome = await session.roll(kept.writer, preflight)

    interrupted, failure = False, None
    with ExitStack() as stack:
        stack.callback(lambda: kept.writer.close() if kept.writer else None)
        stack.enter_context(disk_faults(settings.out))
        try:
            run_on_clock(on_the_bench(), virtual=settings.is_virtual, not_before_s=earlier.t_s, pace=live.pace)
        except KeyboardInterrupt:
            if kept.writer is None:
                raise
            interrupted = True
        except ChordlabError as error:
            if kept.writer is None:
                raise
            failure = error
    if kept.writer is None:  # not reached: without a folder the block above raised
        raise ChordlabError("the session left no folder; run chordlab doctor")
    return Finished(kept.writer.folder, kept.outcome, interrupted, failure)


def recogniser_of(
    dictionary: dict[str, Shape], settings: Settings, called: str, say: Callable[[str], None]
) -> LineRecogniser:
    """The session's recogniser; says how far it is with learning."""
    say(f"dictionary: {len(dictionary)} entries; learning how each looks to a blind robot")
    return recogniser_for(dictionary, settings, called=called, progress=_tenths(say))


def _tenths(say: Callable[[str], None]) -> Callable[[int, int], None]:
    """Say how much of a long dictionary is learnt, a line for each tenth of the way."""
    told = 0

    def progress(done: int, total: int) -> None:
        nonlocal told
        if total >= _LONG_DICTIONARY and 10 * done // total > told:
            told = 10 * done // total
            say(f"learnt {done} of {total} entries")

    return progress


def _session(
    bench: Bench,
    settings: Settings,
    ledger: Ledger,
    tally: Tally,
    turn_seed: np.random.SeedSequence,
    *,
    earlier: Earlier,
    watch: Watcher | None,
    say: Callable[[str], None],
    live: Live,
) -> Session | Listening:
    """What leads the session: this program, or a robot that estimates by itself and is listened to."""
    if bench.guest is not None:
        return Listening(bench, bench.guest, settings, ledger, turn_seed, watch=watch, say=say, live=live)
    robots = len(bench.robots)
    seeds = [turn_seed] if robots == 1 else turn_seed.spawn(robots)
    rngs = [np.random.default_rng(seed) for seed in seeds]
    return Session(bench, settings, ledger, tally, rngs, watch=watch, say=say, earlier=earlier, live=live)


def _introduction(identity: Identity, levels: SessionLevels) -> str:
    """One line on a robot that is ready."""
    text = f"{identity.name}: firmware {identity.firmware}, battery {identity.battery_v:.2f} V"
    return f"{text}; dark {levels.shape.dark_lux:.0f} lux, lit {levels.shape.bright_lux:.0f} lux"


def _manifest(
    settings: Settings,
    shape: Shape,
    dictionary: dict[str, Shape],
    bench: Bench,
    preflight: Preflight,
    recogniser: Recogniser,
    started: datetime,
) -> dict[str, Any]:
    """Everything that one must know to analyse the session years later."""
    font = shape.font
    return {
        "started": started.isoformat(timespec="seconds"),
        "virtual": settings.is_virtual,
        "settings": settings.model_dump(mode="json", exclude={"out"}),
        "seed": settings.seed,
        "shape": {
            "name": shape.name,
            "title": shape.title,
            "digest": shape.digest,
            "geometry": mapping(shape.geometry),
            "font": None if font is None else {"name": font.name, "sha256": font.sha256},
        },
        "dictionary": {name: entry.digest for name, entry in sorted(dictionary.items())},
        "recogniser": type(recogniser).__name__,
        "levels": asdict(preflight.levels[0].shape),
        "devices": devices_of(settings, bench, preflight),
        "calibration": calibration_of(settings),
        "versions": versions(),
    }


def devices_of(settings: Settings, bench: Bench, preflight: Preflight) -> dict[str, Any]:
    """What a manifest says of the devices."""
    return {
        "robot": asdict(preflight.identities[0]),
        "robots": [
            {**asdict(identity), "levels": asdict(levels), "led": settings.led_colour(number)}
            for number, (identity, levels) in enumerate(zip(preflight.identities, preflight.levels, strict=True))
        ],
        "profile": asdict(settings.profile()),
        **bench.devices(),
    }


def calibration_of(settings: Settings) -> dict[str, Any]:
    """What a manifest says of how camera and projector hang."""
    return {
        "camera": settings.camera_calibration().to_dict(),
        "projector": settings.projector_optics.pinhole().to_dict(),
    }


def versions() -> dict[str, str]:
    """Python and the packages that figures may depend on."""
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in _VERSIONED},
    }
