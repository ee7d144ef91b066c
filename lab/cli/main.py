"""The command `chordlab`: one application made of the commands beside this file."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

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
from lab.cli.output import complain

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
    """Run one command. Returns 0 done, 1 the run failed, 2 the request was wrong (one line on stderr)."""
    logging.basicConfig(level=logging.WARNING, format="chordlab: %(message)s", stream=sys.stderr)
    try:
        code = app(list(sys.argv[1:] if argv is None else argv), prog_name="chordlab", standalone_mode=False)
    except TyperException as error:
        complain(f"chordlab: {error.format_message()} See chordlab --help.")
        return 2
    except ChordlabError as error:
        complain(f"chordlab: {error}")
        return error.exit_code
    except KeyboardInterrupt:
        complain("chordlab: interrupted")
        return 1
    except BrokenPipeError:  # the reader of our output left
        return 1
    if code == 130:  # what typer makes of Ctrl-C
        complain("chordlab: interrupted")
        return 1
    return int(code or 0)


def entry() -> None:
    """The console script."""
    sys.exit(main())
