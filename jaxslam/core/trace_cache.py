"""Persistent cache of traced programs: what one process has traced, later ones need not trace.

The first call of a jitted function costs two things:

    Python --trace--> StableHLO --compile--> machine code

JAX's persistent compilation cache (`jax_compilation_cache_dir`) saves the second, but looks machine
code up by its StableHLO, that is, after tracing. For the filters of this package tracing takes
longer than reading the machine code. `jit` of this module therefore stores the StableHLO too, in
the same folder, in the form that `jax.export` serialises.

A call of a function f jitted here:

    if caching is off, or f is called within another trace, or the arguments are on several devices:
        return jax.jit(f)(arguments)
    key = folder, JAX settings, static arguments, tree structure, shapes and dtypes
    if key is not in memory:
        if the static arguments have a text that means the same in every process:
            file = folder / "jaxslam-<name of f>-<SHA-256 of sources, JAX version and key>"
            read the traced program from the file; if that fails, trace f and write the file
            memory[key] = jax.jit(traced program)
        else:
            memory[key] = None
    if memory[key] is None:
        return jax.jit(f)(arguments)
    return memory[key](arguments, committed to their device)

A file is

    bytes 0-31   SHA-256 of the rest
    bytes 32-    serialised `jax.export.Exported`: StableHLO, platform, trees and shapes of the
                 arguments and the results

A damaged file fails its checksum and is written again. A file that cannot be written is skipped. A
change of the package's sources gives all of them new names; `cache_limit` removes old ones.

Why arguments are committed to a device: JAX compiles a program once for committed arrays (bound to
a device by `jax.device_put`) and once more for uncommitted ones (all others). Results of an
exported program are committed, those of a plain `jax.jit` are not. A state that a loop feeds back
would be uncommitted in the first step and committed in the second, and cost a second compilation.
With all arguments committed there is one program, and it is the one that `CachedJit.trace(...)`
compiles ahead of time.
"""

import hashlib
import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax import export
from jax.sharding import SingleDeviceSharding

from jaxslam.core.cache_limit import UNFINISHED, mark_used
from jaxslam.core.quick_compilation import is_short, quick_options

PACKAGE = __name__.split(".")[0]
HOME = Path(__file__).parents[1]
"""Folder of the package's sources."""

SETTINGS = (  # options of JAX that the traced program depends on
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
    "jax_use_shardy_partitioner",
)
DIGEST = 32  # bytes of a SHA-256

_enabled = False


def enable() -> None:
    """Turn the cache on for this process; it works where `jax_compilation_cache_dir` is set."""
    global _enabled
    _enabled = True


def setting(name: str) -> Any:
    """Value of an option of JAX; options are attributes that JAX does not declare."""
    return getattr(jax.config, name)


class _Key(NamedTuple):
    """What a traced program depends on, beside the sources of the package and JAX's version.

    Attributes:
        folder: Folder of the files.
        settings: Platform of the device, and the values of `SETTINGS`.
        static: Names and values of the static arguments that were passed.
        treedef: Structure of the other arguments, by name.
        avals: Shape, dtype and weak type of each of their leaves.
    """

    folder: str
    settings: tuple
    static: tuple[tuple[str, Any], ...]
    treedef: jax.tree_util.PyTreeDef
    avals: tuple[jax.ShapeDtypeStruct, ...]


Quickly = bool | Literal["unoptimised"]


class CachedJit:
    """A jitted function with a persistent trace; made by `jit`."""

    def __init__(self, function: Callable, static: tuple[str, ...], quickly: Quickly = False):
        """Wrap a function, whose arguments with names in `static` are static."""
        self._function = function
        self._static = static
        self._quickly = quickly
        self._signature = inspect.signature(function)
        self._within: jax.stages.Wrapped = jax.jit(function, static_argnames=static)
        self._programs: dict[_Key, jax.stages.Wrapped | None] = {}
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Result of the function."""
        program, args, kwargs = self._find(args, kwargs)
        return program(*args, **kwargs)

    def trace(self, *args: Any, **kwargs: Any) -> jax.stages.Traced:
        """The traced program for such arguments, as `jax.jit(...).trace` returns it.

        Arguments may be `jax.ShapeDtypeStruct`s. Calls use what is compiled from the result.
        """
        program, args, kwargs = self._find(args, kwargs)
        return program.trace(*args, **kwargs)

    def lower(self, **arguments: Any) -> Callable[[], Callable[..., Any]]:
        """Trace and lower the program for such arguments; the result compiles it.

        What that returns takes the arguments that are not static, by name, in any thread.
        """
        program, args, kwargs = self._find((), arguments)
        lowered = program.trace(*args, **kwargs).lower()

        def compiled() -> Callable[..., Any]:
            ready = lowered.compile()
            return ready if program is self._plain else lambda **arrays: ready(arrays)

        return compiled

    @cached_property
    def _plain(self) -> jax.stages.Wrapped:
        """The function jitted by JAX, without a kept trace."""
        if not self._quickly:
            return self._within
        return jax.jit(self._function, static_argnames=self._static, compiler_options=self._options)

    @property
    def _options(self) -> dict[str, Any] | None:
        """Options of XLA; None if there are none."""
        return (quick_options(self._quickly is True) if self._quickly else None) or None

    def _find(self, args: tuple, kwargs: dict) -> tuple[jax.stages.Wrapped, tuple, dict]:
        """Program for such arguments, jitted by JAX, and the arguments to call it with."""
        if self._quickly and _within_another(args, kwargs):  # where JAX allows no options
            return self._within, args, kwargs
        fallback = self._plain, args, kwargs
        folder = setting("jax_compilation_cache_dir")
        if not _enabled or folder is None or setting("jax_disable_jit"):
            return fallback
        arguments = self._signature.bind(*args, **kwargs).arguments
        static = {name: arguments.pop(name) for name in self._static if name in arguments}
        leaves, treedef = jax.tree.flatten(arguments)
        device = _common_device(leaves)
        if device is None:
            return fallback
        settings = device.platform, *(setting(name) for name in SETTINGS)
        key = _Key(folder, settings, tuple(static.items()), treedef, tuple(map(_aval, leaves)))
        if key not in self._programs:
            self._programs[key] = self._load_or_trace(key)
        program = self._programs[key]
        if program is None:
            return fallback
        committed = jax.tree.unflatten(treedef, [_commit(leaf, device) for leaf in leaves])
        return program, (committed,), {}

    def _load_or_trace(self, key: _Key) -> jax.stages.Wrapped | None:
        """Program of a key, from its file or newly traced; None if the key has no stable text."""
        static_text = _stable_text((self._function, key.static))
        if static_text is None or key.settings[0] != jax.default_backend():  # what export targets
            return None
        avals_text = [(aval.shape, aval.dtype, aval.weak_type) for aval in key.avals]
        text = repr((key.settings, static_text, str(key.treedef), avals_text))
        digest = hashlib.sha256(f"{version()} {text}".encode()).hexdigest()
        path = Path(key.folder) / f"{PACKAGE}-{self._function.__name__}-{digest}"
        _register_records()
        exported = _read(path)
        if exported is None:
            exported = self._export(key)
            with suppress(OSError):
                _write(path, exported)

        def program(arrays: dict[str, Any]) -> Any:
            return exported.call(arrays)

        program.__name__ = self._function.__name__
        return jax.jit(program, compiler_options=self._options)

    def _export(self, key: _Key) -> export.Exported:
        """Trace the function, as a program of one dictionary: its arguments that are not static."""
        static = dict(key.static)

        def of_arrays(arrays: dict[str, Any]) -> Any:
            return self._function(**static, **arrays)

        return export.export(jax.jit(of_arrays))(jax.tree.unflatten(key.treedef, key.avals))


def jit(
    function: Callable,
    *,
    static_argnames: str | tuple[str, ...] = (),
    compile_quickly: Quickly = False,
) -> CachedJit:
    """`jax.jit` with a trace that outlives the process; see the module's docstring.

    It is plain `jax.jit` within other traced programs (under `jax.vmap`, `jax.grad` or `jax.jit`),
    and for static arguments without a text that means the same in every process, such as
    functions of other packages.

    Args:
        function: A function of this package that depends on nothing but its arguments and the
            package's sources.
        static_argnames: Names of its static arguments.
        compile_quickly: Whether to compile with `quick_options`, which within other programs are
            those of these; "unoptimised" is for programs that run a few times.
    """
    names = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    return CachedJit(function, tuple(names), compile_quickly)


def jit_by_length(
    function: Callable, *, static_argnames: str | tuple[str, ...] = ()
) -> Callable[[int], CachedJit]:
    """`jit` of a function that runs over scans: of their number, as few are compiled quickly."""
    normally, quickly = (
        jit(function, static_argnames=static_argnames, compile_quickly=q) for q in (False, True)
    )
    return lambda num_scans: quickly if is_short(num_scans) else normally


def _within_another(args: tuple, kwargs: dict) -> bool:
    """Whether a function with such arguments is called while another is being traced."""
    given = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((args, kwargs)))
    return given or isinstance(jax.device_put(np.int32(0)), jax.core.Tracer)


def _common_device(leaves: list[Any]) -> jax.Device | None:
    """Device of the arguments; None where some are being traced, or they are on several."""
    arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    if setting("jax_default_device") or any(isinstance(x, jax.core.Tracer) for x in arrays):
        return None
    devices = {device for x in arrays for device in x.devices()} or {jax.local_devices()[0]}
    return devices.pop() if len(devices) == 1 else None


def _aval(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape, dtype and weak type of an argument."""
    known = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return jax.ShapeDtypeStruct(known.shape, known.dtype, weak_type=known.weak_type)


def _commit(leaf: Any, device: jax.Device) -> Any:
    """An argument, or its shape, bound to a device; a committed array is returned as it is."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=SingleDeviceSharding(device))
    committed = isinstance(leaf, jax.Array) and leaf.committed
    return leaf if committed else jax.device_put(leaf, device)


def _stable_text(static: Any) -> str | None:
    """Text of static arguments that means the same in every process; None if there is none.

    Functions and types of this package are written by module and name. Anything else is written
    by `repr`, and has no stable text if that contains an address (" at 0x...").
    """

    def qualified(value: Any) -> Any:
        if not callable(value):
            return value
        name = f"{value.__module__}.{getattr(value, '__qualname__', '<')}"
        importable = "<" not in name and name.split(".")[0] == PACKAGE  # "<": lambda or local
        return name if importable else value

    text = repr(jax.tree.map(qualified, static))
    return None if " at 0x" in text else text


@cache
def version() -> str:
    """Digest (SHA-256, hexadecimal) of this package's sources and of the versions of JAX."""
    digest = hashlib.sha256(f"{jax.__version__} {jax.lib.__version__}".encode())
    for path in sorted(HOME.rglob("*.py")):
        digest.update(str(path.relative_to(HOME)).encode() + path.read_bytes())
    return digest.hexdigest()


_registered: set[type] = set()
_registering = Lock()


def _register_records() -> None:
    """Give all NamedTuples of this package a name in `jax.export`, which it serialises them by."""
    with _registering:
        for module_name, module in list(sys.modules.items()):
            if module_name.split(".")[0] != PACKAGE:
                continue
            for record in list(vars(module).values()):
                is_record = isinstance(record, type) and hasattr(record, "_fields")
                if is_record and record not in _registered:
                    name = f"{record.__module__}.{record.__qualname__}"
                    export.register_namedtuple_serialization(record, serialized_name=name)
                    _registered.add(record)


def _read(path: Path) -> export.Exported | None:
    """The traced program of a file; None if there is no such file or its checksum is wrong."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    mark_used(path)
    digest, serialised = data[:DIGEST], data[DIGEST:]
    intact = hashlib.sha256(serialised).digest() == digest
    return export.deserialize(bytearray(serialised)) if intact else None


def _write(path: Path, exported: export.Exported) -> None:
    """Write a traced program to a file, which other processes see whole or not at all.

    It is written in a temporary folder beside its destination and then renamed (atomic).
    """
    serialised = bytes(exported.serialize())
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=path.parent, prefix=UNFINISHED) as folder:
        temporary = Path(folder) / path.name
        temporary.write_bytes(hashlib.sha256(serialised).digest() + serialised)
        temporary.replace(path)
