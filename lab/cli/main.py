"""The command `chordlab`: one application made of the commands beside this file."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import typer
from typer.exceptions import TyperException

from lab.base.errors import ChordlabError
from lab.cli import (
    batch,
    calibrate,
    characterise,
    classes,
    doctor,
    export,
    figures,
    geometry,
    plan,
    project,
    recognize,
    recover,
    robot,
    run,
    shapes,
    track,
    validate,
    watch,
)
from lab.cli.output import complain, fail, refused

app = typer.Typer(
    name="chordlab",
    help="Blind shape recognition: a full lab session, its validation, its analysis.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("run")(run.run)
app.command("watch")(watch.watch)
app.command("validate")(validate.validate)
app.command("recognize")(recognize.recognize)
app.command("recover")(recover.recover)
app.command("finalize")(validate.finalize)
app.command("batch")(batch.batch)
app.command("figures")(figures.figures)
app.command("classes")(classes.classes)
app.command("plan")(plan.plan)
app.command("track")(track.track)
app.command("moments")(geometry.moments)
app.command("simulate")(geometry.simulate)
app.command("project")(project.project)
app.command("export")(export.export)
app.command("doctor")(doctor.doctor)
app.add_typer(shapes.app, name="shapes")
app.add_typer(robot.app, name="robot")
robot.app.command("characterise")(characterise.characterise)
app.add_typer(calibrate.app, name="calibrate")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns 0 done, 1 the run failed, 2 the request was wrong; then one line on stderr says what, and the cure. With
    CHORDLAB_DEBUG set, the traceback too.
    """
    logging.basicConfig(level=logging.WARNING, format="chordlab: %(message)s", stream=sys.stderr)
    if sys.stdout is None:  # pyright: ignore[reportUnnecessaryComparison] - so Python leaves it where it was closed
        fail("stdout is closed, and results go there; leave it open, or send it to /dev/null")
        return 2
    try:
        code = int(app(list(sys.argv[1:] if argv is None else argv), prog_name="chordlab", standalone_mode=False) or 0)
        sys.stdout.flush()  # here, where what it says can be answered
    except KeyboardInterrupt:
        code = _CTRL_C
    except BrokenPipeError:  # the reader of our output left
        _let_go_of_stdout()
        return 1
    except Exception as error:  # noqa: BLE001 - the last to hear of it: nobody is to meet a traceback unasked
        if os.environ.get("CHORDLAB_DEBUG"):
            traceback.print_exc()
        code, text = _told(error)
        if text:
            fail(text)
        if isinstance(error, OSError):
            _let_go_of_stdout()
        return code
    if code == _CTRL_C:
        complain("interrupted")
        return 1
    return code


_CTRL_C = 130  # what typer makes of it


def _told(error: Exception) -> tuple[int, str]:
    """The exit code of an error, and what to say of it."""
    if isinstance(error, ChordlabError):
        return error.exit_code, str(error)
    if isinstance(error, TyperException):
        context, text = getattr(error, "ctx", None), error.format_message()
        if context is not None and text == context.get_help():  # a group alone: which commands it has
            complain(text)
            return 2, ""
        return 2, f"{text} See {context.command_path if context else 'chordlab'} --help."
    if isinstance(error, OSError):
        return (2 if error.filename else 1), refused(error)
    trace = traceback.extract_tb(error.__traceback__)
    place = f"{Path(trace[-1].filename).name}:{trace[-1].lineno}" if trace else "nowhere"
    return 1, (
        f"a fault of chordlab itself, {type(error).__name__} at {place}: {error}; please report it, with what "
        "`chordlab doctor --bundle` packs and what CHORDLAB_DEBUG=1 before the same command shows"
    )


def _let_go_of_stdout() -> None:
    """Nothing more can be written there: Python is not to try when it ends."""
    with suppress(OSError, ValueError):  # a test's stdout has no descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry() -> None:
    """The console script."""
    sys.exit(main())
