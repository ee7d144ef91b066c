"""`chordlab shapes`: what is in the dictionary, and one shape as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lab.cli.output import JsonFlag, emit, say, show_table
from projector.dictionary import load_dictionary, shape_from
from projector.draw import draw_shape

app = typer.Typer(help="The dictionary of shapes.", no_args_is_help=True)

ShapeArgument = Annotated[
    str, typer.Argument(metavar="SHAPE", help="A dictionary name, text:WORD, or a .geojson, .svg or .png file.")
]
FontOption = Annotated[Path | None, typer.Option("--font", help="Font file for text:WORD.")]


@app.command("list")
def list_shapes(as_json: JsonFlag = False) -> None:
    """List the dictionary with each entry's figures.

    Example: chordlab shapes list
    """
    entries = load_dictionary().values()
    if as_json:
        emit({"shapes": [_figures(entry.name) for entry in entries]})
        return
    show_table(
        "Dictionary",
        ("name", "title", "A, cm²", "P, cm", "pieces", "holes"),
        [(e.name, e.title, f"{e.area_cm2:.1f}", f"{e.perimeter_cm:.1f}", str(e.pieces), str(e.holes)) for e in entries],
    )


@app.command("show")
def show(
    shape: ShapeArgument,
    font: FontOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Picture to write, .png or .svg. Default: NAME.png here.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Draw one shape to scale, with its area and perimeter.

    Example: chordlab shapes show eiffel --out eiffel.png
    """
    drawn = shape_from(shape, font=font)
    target = out or Path(f"{drawn.name.replace(':', '_')}.png")
    draw_shape(drawn, target)
    if as_json:
        emit({**_figures(shape, font), "picture": target})
        return
    say(f"{drawn.title}: A = {drawn.area_cm2:.1f} cm², P = {drawn.perimeter_cm:.1f} cm")
    if drawn.font is not None:
        say(f"font: {drawn.font.name}")
    say(str(target))


def _figures(spec: str, font: Path | None = None) -> dict[str, object]:
    shape = shape_from(spec, font=font)
    width_cm, height_cm = shape.size_cm
    return {
        "name": shape.name,
        "title": shape.title,
        "area_cm2": shape.area_cm2,
        "perimeter_cm": shape.perimeter_cm,
        "width_cm": width_cm,
        "height_cm": height_cm,
        "pieces": shape.pieces,
        "holes": shape.holes,
        "digest": shape.digest,
        "source": shape.source,
    }
