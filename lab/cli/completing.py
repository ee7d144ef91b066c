"""What a shell offers for the values of arguments and options. Quick: nothing is loaded, no folder is read deeply."""

from __future__ import annotations

from pathlib import Path

from projector.catalogue import COLLECTIONS, DRAWN, drawn_files

_MOST = 200  # sessions; a longer list helps nobody
_DRAWINGS = (".geojson", ".svg", ".png", ".jpg")


def shapes(incomplete: str) -> list[str]:
    """The dictionary's drawn shapes, ``text:``, and the drawings in the folder that is being named."""
    names = [name for collection in DRAWN for name in drawn_files(collection)]
    return [*names, "text:", *_files(incomplete, _DRAWINGS)]


def collections() -> list[str]:
    """The dictionary's collections."""
    return list(COLLECTIONS)


def sessions(incomplete: str) -> list[str]:
    """Session folders, in the folder that is being named and one below it; of many, the last."""
    folder, begin = _named(incomplete)
    found = [path.parent for depth in ("", "*/") for path in folder.glob(f"{begin}*/{depth}manifest.json")]
    return [path.as_posix() for path in sorted(found, reverse=True)[:_MOST]]


def settings_files(incomplete: str) -> list[str]:
    """The TOML files in the folder that is being named."""
    return _files(incomplete, (".toml",))


def robots() -> list[str]:
    """The robots that are there without a radio."""
    return ["virtual", "onboard:virtual"]


def projectors() -> list[str]:
    """The displays of most benches."""
    return ["display:0", "display:1"]


def _files(incomplete: str, suffixes: tuple[str, ...]) -> list[str]:
    folder, begin = _named(incomplete)
    return [path.as_posix() for path in sorted(folder.glob(f"{begin}*")) if path.suffix.lower() in suffixes]


def _named(incomplete: str) -> tuple[Path, str]:
    """The folder that is being named, and how the name in it begins."""
    path = Path(incomplete)
    return (path, "") if not incomplete or incomplete.endswith("/") else (path.parent, path.name)
