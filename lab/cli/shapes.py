"""`chordlab shapes`: what is in the dictionary, pictures of it, shapes from files, and what can be told apart."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.choosing import (
    CollectionOption,
    FontOption,
    ShapeArguments,
    chosen_shapes,
    leaving,
    picture_path,
)
from lab.cli.learn import learn
from lab.cli.output import JsonFlag, QuietFlag, emit, say, show_table
from lab.cli.reading import show_reading
from lab.cli.separability import show_separability
from projector.catalogue import DRAWN, PAPER, drawn_files

if TYPE_CHECKING:
    from projector.dictionary import Shape


app = typer.Typer(help="The dictionary of shapes.", no_args_is_help=True)

_SAID = 6  # shapes whose figures are printed beside their picture


@app.command("list")
def list_shapes(collection: CollectionOption = PAPER, font: FontOption = None, as_json: JsonFlag = False) -> None:
    """List a collection with each entry's figures.

    Example: chordlab shapes list --collection monuments
    """
    from projector.dictionary import load_dictionary

    entries = load_dictionary(collection or PAPER, font=font).values()
    if as_json:
        emit({"collection": collection, "shapes": [_figures(entry) for entry in entries]})
        return
    show_table(
        f"Dictionary: {collection}, {len(entries)} shapes",
        ("name", "title", "A, cm²", "P, cm", "pieces", "holes"),
        [(e.name, e.title, f"{e.area_cm2:.1f}", f"{e.perimeter_cm:.1f}", str(e.pieces), str(e.holes)) for e in entries],
    )


@app.command("show")
def show(
    shapes: ShapeArguments = None,
    collection: CollectionOption = None,
    font: FontOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Picture to write, .png, .svg or .pdf. Default: NAME.png here.")
    ] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Draw shapes to scale. One, or several in one gallery, with area and perimeter.

    Example: chordlab shapes show --collection letters --out letters.png
    """
    from projector.draw import draw_gallery, draw_shape

    chosen = chosen_shapes(shapes, collection, font)
    if not chosen:
        raise RequestError("nothing to show; name a shape, or give --collection monuments")
    target = picture_path(out or Path(f"{collection or chosen[0].name.replace(':', '_')}.png"))
    with leaving(target):
        if len(chosen) == 1:
            draw_shape(chosen[0], target)
        else:
            draw_gallery(chosen, target)
    if as_json:
        figures = [_figures(shape) for shape in chosen]
        emit({**figures[0], "picture": target} if len(chosen) == 1 else {"shapes": figures, "picture": target})
        return
    if quiet:
        say(str(target))
        return
    for drawn in chosen if len(chosen) <= _SAID else []:
        say(f"{drawn.title}: A = {drawn.area_cm2:.1f} cm², P = {drawn.perimeter_cm:.1f} cm")
    for name in {drawn.font.name for drawn in chosen if drawn.font is not None}:
        say(f"font: {name}")
    say(str(target))


@app.command("import")
def import_file(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A .svg, .png, .jpg or .geojson file, or text:WORD.")],
    name: Annotated[
        str | None, typer.Option("--name", help="The shape's name: letters, digits, - and _. Default: the file's.")
    ] = None,
    title: Annotated[
        str | None, typer.Option("--title", help="What people read. Default: the file's own, or NAME.")
    ] = None,
    width: Annotated[float | None, typer.Option("--width", help="Width of the box, cm.")] = None,
    height: Annotated[
        float | None, typer.Option("--height", help="Height of the box (of a text's capitals), cm.")
    ] = None,
    area: Annotated[float | None, typer.Option("--area", help="Area, cm².")] = None,
    scale: Annotated[
        float | None, typer.Option("--scale", help="Factor on the file's own size (cm a pixel if it states none).")
    ] = None,
    mend: Annotated[bool, typer.Option("--mend", help="Close open outlines, untangle those that cross.")] = False,
    font: FontOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="GeoJSON to write. Default: NAME.geojson here.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write over a file that is there.")] = False,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a shape from a drawing, picture or text. In cm, checked and centred, as a GeoJSON file.

    Without a size a file that states one keeps it; anything else is fitted into 100 x 70 cm.

    Example: chordlab shapes import tower.svg --name tower --height 70
    """
    from lab.settings.sections import ArenaSettings
    from projector.geojson import write_shape
    from projector.importers import import_shape

    taken = {known for collection in DRAWN for known in drawn_files(collection)}
    made = import_shape(
        file,
        name,
        title=title,
        font=font,
        width_cm=width,
        height_cm=height,
        area_cm2=area,
        scale=scale,
        mend=mend,
        arena=ArenaSettings().lines_within,
        taken=taken,
    )
    target = out or Path(f"{made.shape.name}.geojson")
    if target.suffix.lower() not in (".geojson", ".json"):
        raise RequestError(f"{target}: a shape is written as GeoJSON; give --out NAME.geojson")
    if target.exists() and not overwrite:
        raise RequestError(f"{target}: is there already; give another --out, or --overwrite")
    with leaving(target):
        write_shape(made.shape, target)
    if as_json:
        emit({**_figures(made.shape), "notes": made.notes, "file": target})
        return
    if quiet:
        say(str(target))
        return
    width_cm, height_cm = made.shape.size_cm
    say(
        f"{made.shape.name}: {width_cm:.1f} x {height_cm:.1f} cm, A = {made.shape.area_cm2:.1f} cm²,"
        f" P = {made.shape.perimeter_cm:.1f} cm, pieces {made.shape.pieces}, holes {made.shape.holes}"
    )
    for note in made.notes:
        say(note)
    say(str(target))


app.command("separability")(show_separability)
app.command("reading")(show_reading)
app.command("learn")(learn)


def _figures(shape: Shape) -> dict[str, object]:
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
