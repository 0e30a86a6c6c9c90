"""Programs that are traced once for all processes.

JAX keeps compiled programs for later processes where `jax_compilation_cache_dir` says, and finds
them by what tracing gave: to trace anew in each process takes longer than to read them. What `jit`
of this module has traced is kept beside them, by those who ask for it with `keep`.
"""

import hashlib
import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import jax
from jax import export
from jax.sharding import SingleDeviceSharding

PACKAGE = __name__.split(".")[0]
SETTINGS = (  # of JAX, that what tracing gives depends on
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
    "jax_use_shardy_partitioner",
)
DIGEST = 32  # bytes of SHA-256

_keeps = False


def keep() -> None:
    """Keep what is traced from here on where JAX keeps compiled programs, if it does."""
    global _keeps
    _keeps = True


class Jitted:
    """A jitted function, made by `jit`."""

    def __init__(self, function: Callable, static: tuple[str, ...]):
        """Prepare it."""
        self._function = function
        self._static = static
        self._signature = inspect.signature(function)
        self._plain = jax.jit(function, static_argnames=static)
        self._programs: dict[Any, Callable | None] = {}
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """What the function gives."""
        program, args, kwargs = self._find(args, kwargs)
        return program(*args, **kwargs)

    def trace(self, *args: Any, **kwargs: Any) -> jax.stages.Traced:
        """The program for such arguments, as of `jax.jit`; what is compiled of it serves calls."""
        program, args, kwargs = self._find(args, kwargs)
        return program.trace(*args, **kwargs)

    def _find(self, args: tuple, kwargs: dict) -> tuple[Callable, tuple, dict]:
        """A function jitted by JAX, and what to call it with."""
        plain = self._plain, args, kwargs
        folder = jax.config.jax_compilation_cache_dir
        if not _keeps or folder is None or jax.config.jax_disable_jit:
            return plain
        given = self._signature.bind(*args, **kwargs).arguments
        static = {name: given.pop(name) for name in self._static if name in given}
        leaves, form = jax.tree.flatten(given)
        device = _device(leaves)
        if device is None:
            return plain
        shapes = tuple(map(_shape, leaves))
        settings = device.platform, *(getattr(jax.config, name) for name in SETTINGS)
        key = folder, settings, tuple(static.items()), form, shapes
        if key not in self._programs:
            told = _told((self._function, static))
            text = told and repr(
                (settings, told, str(form), [(x.shape, x.dtype, x.weak_type) for x in shapes])
            )
            shapes = form.unflatten(shapes)
            self._programs[key] = text and self._program(Path(folder), text, static, shapes)
        if self._programs[key] is None:
            return plain
        return self._programs[key], (form.unflatten(_put(x, device) for x in leaves),), {}

    def _program(self, folder: Path, text: str, static: dict, shapes: dict) -> Callable:
        """What was traced for such arguments, by this process or one before."""
        name = hashlib.sha256(f"{version()} {text}".encode()).hexdigest()
        path = folder / f"{PACKAGE}-{self._function.__name__}-{name}"
        _know_records()
        exported = _read(path)
        if exported is None:
            of_arrays = jax.jit(lambda given: self._function(**static, **given))
            exported = export.export(of_arrays)(shapes)
            with suppress(OSError):
                _write(path, exported)
        program = lambda given: exported.call(given)
        program.__name__ = self._function.__name__
        return jax.jit(program)


def jit(function: Callable, *, static_argnames: str | tuple[str, ...] = ()) -> Jitted:
    """`jax.jit`, whose traces outlive the process where JAX keeps compiled programs.

    Within other programs, and with static arguments that another process would not know again,
    such as functions of other packages, it is no more than `jax.jit`.

    Args:
        function: Of a module of this package, whose sources tell all that it does.
        static_argnames: Names of its arguments that are static.
    """
    names = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    return Jitted(function, tuple(names))


def _device(leaves: list[Any]) -> jax.Device | None:
    """Device for arguments; None where some are traced, or they are on several."""
    arrays = [x for x in leaves if isinstance(x, jax.Array)]
    if jax.config.jax_default_device or any(isinstance(x, jax.core.Tracer) for x in arrays):
        return None
    devices = {device for x in arrays for device in x.devices()} or {jax.local_devices()[0]}
    return devices.pop() if len(devices) == 1 else None


def _shape(x: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of an argument."""
    x = x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)
    return jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type)


def _put(x: Any, device: jax.Device) -> Any:
    """An argument, or its shape, on a device and nowhere else, as results of such programs are."""
    if isinstance(x, jax.ShapeDtypeStruct):
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=SingleDeviceSharding(device))
    there = isinstance(x, jax.Array) and x.committed
    return x if there else jax.device_put(x, device)


def _told(static: Any) -> str | None:
    """Text by which another process knows hashable objects; None if there is none."""

    def name(x: Any) -> Any:
        if not callable(x):
            return x
        name = f"{x.__module__}.{getattr(x, '__qualname__', '<')}"
        return x if "<" in name or name.split(".")[0] != PACKAGE else name

    text = repr(jax.tree.map(name, static))
    return None if " at 0x" in text else text


@cache
def version() -> str:
    """What tells this package's programs from others: a digest of its sources, and of JAX."""
    digest = hashlib.sha256(f"{jax.__version__} {jax.lib.__version__}".encode())
    home = Path(__file__).parent
    for path in sorted(home.rglob("*.py")):
        digest.update(str(path.relative_to(home)).encode() + path.read_bytes())
    return digest.hexdigest()


_known: set[type] = set()
_knowing = Lock()


def _know_records() -> None:
    """Tell JAX the names of this package's records, by which it can read them."""
    with _knowing:
        for name, module in list(sys.modules.items()):
            for record in vars(module).values() if name.split(".")[0] == PACKAGE else ():
                if isinstance(record, type) and hasattr(record, "_fields") and record not in _known:
                    text = f"{record.__module__}.{record.__qualname__}"
                    export.register_namedtuple_serialization(record, serialized_name=text)
                    _known.add(record)


def _read(path: Path) -> export.Exported | None:
    """What was traced, from a file; None if it is not whole."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    whole = hashlib.sha256(data[DIGEST:]).digest() == data[:DIGEST]
    return export.deserialize(bytearray(data[DIGEST:])) if whole else None


def _write(path: Path, exported: export.Exported) -> None:
    """Write what was traced to a file, which appears whole or not at all."""
    data = bytes(exported.serialize())
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=path.parent, prefix=".unfinished-") as own:
        whole = Path(own) / path.name
        whole.write_bytes(hashlib.sha256(data).digest() + data)
        whole.replace(path)
