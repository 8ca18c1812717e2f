"""The source code that a function depends on."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import re
import sys
import sysconfig
import time
from pathlib import Path

LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
# import statements; `ast` takes ten times as long, in every worker
IMPORT = re.compile(rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))", re.M)
NAME = re.compile(rb"(?:^|,)[\s(]*([\w.]+)")
COMMENT = re.compile(rb"#[^\n]*")
STARTED = time.time()


@functools.cache
def source_hash(*modules: str) -> bytes:
    """Return the SHA-256 of all `source_files` of `modules` and of the versions of the libraries they import.

    Raises `LookupError` where a module has no source file, such as one typed into an interpreter.
    """
    files, libraries = _closure(modules)
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(name.encode() + hashlib.sha256(files[name].read_bytes()).digest())
    for name in sorted(libraries):
        digest.update(f"{name} {_version(name)}".encode())
    return digest.digest()


def source_files(*modules: str) -> dict[str, Path]:
    """Return the files, by module, of `modules` and of the local modules that these import, directly or not.

    Imports inside functions and the packages above a module are followed too, those by a computed name only where a
    package imports all its modules by `iter_modules(__path__)`. Local are this package, that of the first module, and
    all that is neither installed nor in the standard library.
    """
    return _closure(modules)[0]


def unchanged(*modules: str) -> bool:
    """Return whether no source file changed since this process started, so that they equal the loaded code."""
    return all(file.stat().st_mtime < STARTED for file in source_files(*modules).values())


@functools.cache
def _closure(modules: tuple[str, ...]) -> tuple[dict[str, Path], set[str]]:
    """Return the files of local modules by name, and the names of the libraries they import."""
    for name in modules:
        if _file(name) is None and getattr(sys.modules.get(name), "__file__", None) is None:
            raise LookupError(f"module {name} has no source file")
    own = ("driftjax", modules[0].split(".")[0])
    files: dict[str, Path] = {}
    libraries: set[str] = set(LIBRARIES)
    queue = list(modules)
    while queue:
        name = queue.pop()
        root, file = name.split(".")[0], _file(name)
        if name in files or file is None:
            continue
        if root in own or not str(file).startswith(INSTALLED):
            files[name] = file
            above = name.rpartition(".")[0]
            # the facade lists every public name, of which a module below it runs none
            queue += [*_imports(name, file), *([above] if above != "driftjax" else [])]
        elif root not in sys.stdlib_module_names:
            libraries.add(root)
    return files, libraries


@functools.cache
def _imports(module: str, file: Path) -> set[str]:
    """Return the modules that a file imports, and what may be one: `b` of `from a import b` if `a` is a package."""
    package, names = module if file.name == "__init__.py" else module.rpartition(".")[0], set()
    text = COMMENT.sub(b"", file.read_bytes())
    if b"iter_modules(__path__)" in text:  # a package that imports all its modules, whatever their names
        names |= {f"{module}.{one.stem}" for one in file.parent.glob("[!_]*.py")}
    for origin, members, plain in IMPORT.findall(text):
        if plain:
            names |= {name.decode() for name in NAME.findall(plain)}
            continue
        origin = origin.decode()
        if level := len(origin) - len(origin.lstrip(".")):  # relative: one dot is the package itself
            origin = ".".join([*package.split(".")[: 1 - level or None], origin.lstrip(".")]).strip(".")
        names.add(origin)
        above = _file(origin)
        if above is None or above.name == "__init__.py":
            names |= {f"{origin}.{name.decode()}" for name in NAME.findall(members)}
    return names


@functools.cache
def _file(module: str) -> Path | None:
    """Return the source file of a module without importing it; None where there is none."""
    if loaded := getattr(sys.modules.get(module), "__file__", None):
        return Path(loaded) if loaded.endswith(".py") else None
    root, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(root)
    except (ImportError, ValueError):  # ValueError: of no module's name, or of `__main__` without a file
        return None
    if spec is None:
        return None
    places = [Path(place, *rest) for place in spec.submodule_search_locations or ()]
    files = [file for place in places for file in (place / "__init__.py", place.with_suffix(".py"))]
    files += [] if rest or not spec.has_location else [Path(str(spec.origin))]
    return next((file for file in files if file.suffix == ".py" and file.is_file()), None)


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:  # distributed under another name
        return ""
