# SPDX-License-Identifier: Apache-2.0
"""Kernels through numba: the part of `jit` that needs the compiler."""

from __future__ import annotations

import dis
import gc
import hashlib
import itertools
import pickle
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import version
from typing import Any, NamedTuple

import numba
from llvmlite.binding import Linkage, parse_assembly
from numba.core import config, typed_passes, untyped_passes
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_machinery import PassManager
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.runtime import nrtdynmod, rtsys
from numba.core.serialize import dumps
from numba.core.types import Array, Function
from numba.core.types.containers import BaseNamedTuple, BaseTuple
from numba.core.types.misc import unliteral

from iwm_power_manager import jit, kernel_cache
from iwm_power_manager.held_type import HeldType
from iwm_power_manager.jit import Kernel
from iwm_power_manager.kernel_cache import Store, UnknownSourceError

#: What turns a result into Python objects and arguments into numbers is left out: only kernels call it.
_NO_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

STORE = Store()


def _runtime(target: Any) -> Any:
    """Numba's run time, kept like a kernel: compiling it takes 30 MB that every process would keep to its end."""
    codegen = target.codegen()
    depends_on = f"{_compiler()} {codegen.magic_tuple()}"
    file = f"numba.runtime-{hashlib.sha256(depends_on.encode()).hexdigest()[:32]}"
    data = STORE.load(file)
    if data is not None:
        try:
            return codegen.unserialize_library(pickle.loads(data))  # noqa: S301 whole, and our own
        except Exception:  # noqa: BLE001 whatever an unusable file makes of the loader
            STORE.say_damaged(file)
    module, library = nrtdynmod.create_nrt_module(target)
    library.enable_object_caching()
    library.add_ir_module(module)
    library.finalize()
    STORE.save(file, pickle.dumps(library.serialize_using_object_code()))
    return library


nrtdynmod.compile_nrt_functions = _runtime


def _compiler() -> str:
    return f"{kernel_cache.environment()} numba {numba.__version__} llvmlite {version('llvmlite')}"


class Use(NamedTuple):
    """An entry point that was needed.

    Attributes
    ----------
    kernel : its full name
    file : what it is kept as
    found : it had been compiled before
    seconds : what loading or compiling it took
    """

    kernel: str
    file: str
    found: bool
    seconds: float


#: Every entry point that this process has needed, in this order.
USES: list[Use] = []


class NotKeptError(Exception):
    """A kernel is not on disk, and nothing may be compiled now.

    Attributes
    ----------
    can_be_kept : another process can compile it for this one: its sources are those that run here
    """

    def __init__(self, kernel: str, can_be_kept: bool = True) -> None:
        why = "" if can_be_kept else ": its sources have changed since this process was started"
        super().__init__(f"{kernel} has not been compiled{why}")
        self.can_be_kept = can_be_kept


_KEPT_ONLY = ContextVar("kept_only", default=False)


@contextmanager
def kept_only() -> Iterator[None]:
    """In the body of the `with`, in this thread, kernels are only read from disk.

    Raises
    ------
    NotKeptError
        One would have to be compiled.
    """
    before = _KEPT_ONLY.set(True)
    try:
        yield
    finally:
        _KEPT_ONLY.reset(before)


#: Functions compiled in this process, by module and name.
_COMPILED: set[str] = set()

#: What kernels use of NumPy that makes no array.
_SCALAR = frozenset({"float32", "float64", "inf", "int16", "int32", "int64", "searchsorted"})


def _makes_arrays(kernel: Kernel) -> bool:
    """Whether a kernel may make an array of its own: whether it uses of NumPy what is not `_SCALAR`."""
    code = list(dis.get_instructions(kernel.py_func))
    return any(
        use.argval not in _SCALAR
        for module, use in itertools.pairwise(code)
        if module.opname == "LOAD_GLOBAL" and module.argval == "np"
    )


def _options(kernel: Kernel) -> dict[str, Any]:
    """Numba's options for a kernel.

    References are counted only where arrays are made. Whoever calls a kernel holds its arrays until it returns; numba
    would count them all the same, at every call and for every array of a car and a policy, with atomic operations that
    take longer than the arithmetic.
    """
    return {
        "nopython": True,
        "error_model": "numpy",
        "nogil": kernel.releases_lock,
        "_nrt": _makes_arrays(kernel),
    }


#: Numba's passes without those for closures, `with`, literals, inlined functions and expressions of whole arrays.
_SCALAR_PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.RewriteSemanticConstants,
    untyped_passes.DeadBranchPrune,
    untyped_passes.GenericRewrites,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
    typed_passes.AnnotateTypes,
    typed_passes.NativeLowering,
    typed_passes.NoPythonBackend,
)


class _Code(JITCodeLibrary):
    """Code that is only linked into other code: optimised there, once, and no machine code of its own."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _Typing:
    """Numba's typing context, which looks for the types of `a + b` in all its tables once, not at each `+`."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._found: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, arguments: Any, names: Any) -> Any:
        """As numba's; built-in operators are remembered."""
        if not isinstance(function, Function) or names:
            return self._context.resolve_function_type(function, arguments, names)
        key = (function, arguments)
        if key not in self._found:
            self._found[key] = self._context.resolve_function_type(function, arguments, names)
        return self._found[key]


_TYPING = _Typing(cpu_target.typing_context)


class _ScalarCompiler(Compiler):
    """Numba's compiler, with fewer passes for kernels that have neither arrays of their own nor functions inside."""

    def define_pipelines(self) -> list[PassManager]:
        """Numba's passes, or `_SCALAR_PASSES`: they make the same code of such a kernel."""
        if self.state.flags.nrt or any(hasattr(value, "co_code") for value in self.state.func_id.code.co_consts):
            return super().define_pipelines()
        manager = PassManager("kernel")
        for step in _SCALAR_PASSES:
            manager.add_pass(step, step.__name__)
        manager.finalize()
        return [manager]


class _PartCompiler(_ScalarCompiler):
    """Numba's compiler, up to the code that is linked into the caller."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, result: Any, flags: Any, names: Any) -> None:
        flags.no_compile = True
        super().__init__(_TYPING, target, library or _Code(target.codegen(), "part"), args, result, flags, names)


def _holds_arrays(kind: Any) -> bool:
    return isinstance(kind, Array) or (isinstance(kind, BaseTuple) and any(map(_holds_arrays, kind.types)))


class _Part(CPUDispatcher):
    """A kernel as other kernels call it."""

    def get_call_template(self, arguments: Any, names: Any) -> Any:
        """As numba's, but True and False, 1 and 2 are one type each: no copy of the kernel for every literal."""
        _, arguments = self._compiler.fold_argument_types(arguments, names)
        return super().get_call_template(tuple(unliteral(kind) for kind in arguments), {})

    def compile(self, signature: Any) -> Any:
        """Compile it for a signature; whoever calls it holds numba's lock."""
        if (found := self.overloads.get(signature)) is None:
            self.add_overload(self._compiler.compile(signature, None))
        return found

    def add_overload(self, result: CompileResult) -> None:
        """Let callers find what was compiled; there is nothing that Python could call."""
        if _holds_arrays(result.signature.return_type):  # with whose reference?
            raise TypeError(
                f"{self.py_func.__qualname__} returns arrays to another kernel: let it fill what it is given"
            )
        result = result._replace(entry_point=_EntryPoint())
        self.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
        self.overloads[tuple(result.signature.args)] = result
        _count(self.py_func)


def _count(function: Any) -> None:
    """A function is compiled."""
    name = f"{function.__module__} {function.__qualname__}"
    if jit.watch is not None and name not in _COMPILED:
        jit.watch.ready()
    _COMPILED.add(name)


class _EntryPoint:
    """Stands for the address that a part does not have."""


def part(kernel: Kernel) -> CPUDispatcher:
    """A kernel as other kernels call it."""
    return _Part(kernel.py_func, targetoptions=_options(kernel) | _NO_WRAPPERS, pipeline_class=_PartCompiler)


class _WholeCode(JITCodeLibrary):
    """All code of an entry point.

    Nobody else calls its parts, so that LLVM may suit them to their only callers: without what is not used of a car and
    a policy, which are hundreds of numbers to copy at every call.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        super()._optimize_final_module()

    def _get_module_for_linking(self) -> Any:
        """Names only: what no other code is linked with is kept as machine code, which takes far less memory."""
        module = self._final_module
        known = [
            f'@"{value.name}" = global i8 0'
            for value in itertools.chain(module.functions, module.global_variables)
            if not value.is_declaration and value.linkage in (Linkage.external, Linkage.common)
        ]
        return parse_assembly("\n".join([str(self._codegen._create_empty_module(self.name)), *known]))


class _EntryCompiler(_ScalarCompiler):
    """Numba's compiler, for code that is called from Python only."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, result: Any, flags: Any, names: Any) -> None:
        library = _WholeCode(target.codegen(), "entry")
        library.enable_object_caching()
        super().__init__(_TYPING, target, library, args, result, flags, names)


class _Entry(CPUDispatcher):
    """A kernel as Python calls it."""

    def compile(self, signature: Any) -> Any:
        """Find or compile it for a signature; the compiler makes no garbage worth looking for meanwhile."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super().compile(signature)
        finally:
            if collecting:
                gc.enable()
            if jit.watch is not None:
                jit.watch.end()


def entry_point(kernel: Kernel) -> CPUDispatcher:
    """A kernel as Python calls it."""
    options = _options(kernel) | {"no_cfunc_wrapper": True}
    dispatcher = _Entry(kernel.py_func, targetoptions=options, pipeline_class=_EntryCompiler)
    dispatcher._cache = _Cache(kernel)
    return dispatcher


def described(kind: Any) -> str:
    """A numba type, with the fields of tuples: the class has the same name after a field has moved."""
    if isinstance(kind, BaseNamedTuple):
        cls = kind.instance_class
        fields = ",".join(f"{name}:{described(part)}" for name, part in zip(kind.fields, kind.types, strict=True))
        return f"{cls.__module__}.{cls.__qualname__}({fields})"
    if isinstance(kind, BaseTuple):
        return f"({','.join(map(described, kind.types))})"
    if isinstance(kind, HeldType):
        return f"Held({described(kind.kind)})"
    return repr(kind)


def key_of(kernel: Kernel, signature: Sequence[Any], processor: Any) -> str:
    """Hash of all that a compiled kernel depends on, 32 hex digits.

    Raises
    ------
    UnknownSourceError
        The sources cannot be read.
    """
    function = kernel.py_func
    reach = kernel_cache.reach(function, lambda value: isinstance(value, Kernel))
    closure = kernel_cache.import_closure(sorted(reach.modules))
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    if any(not isinstance(cell, Kernel | int | float | str | bool) for cell in cells):
        raise UnknownSourceError(function.__qualname__)
    parts = [
        _compiler(),
        repr((processor, config.OPT, config.BOUNDSCHECK, config.USING_SVML, sorted(_options(kernel).items()))),
        f"{function.__module__}.{function.__qualname__} {cells!r}",
        reach.code,
        *(f"{name} {closure[name]}" for name in sorted(closure)),
        *map(described, signature),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


class _Cache(NullCache):
    """Compiled entry points of one kernel, on disk."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._files: dict[Any, str | None] = {}
        self._started_s: dict[Any, float] = {}

    @property
    def _name(self) -> str:
        return f"{self._kernel.py_func.__module__}.{self._kernel.py_func.__qualname__}"

    def _file(self, signature: Any, context: Any) -> str | None:
        if signature not in self._files:
            try:
                key = key_of(self._kernel, signature, context.codegen().magic_tuple())
                self._files[signature] = f"{self._name.replace('<', '').replace('>', '')}-{key}"
            except (UnknownSourceError, OSError, SyntaxError, UnicodeDecodeError):
                self._files[signature] = None
        return self._files[signature]

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """The compiled kernel for a signature, or None."""
        self._started_s[sig] = time.perf_counter()
        # What has been compiled needs numba's run time, not the hundreds of modules that compiling takes.
        rtsys.initialize(target_context)
        file = self._file(sig, target_context)
        data = STORE.load(file) if file else None
        result = None
        if file and data is not None:
            try:
                result = CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301 whole, and our own
            except Exception:  # noqa: BLE001 whatever an unusable file makes of the loader
                STORE.say_damaged(file)
        if result is not None:
            USES.append(Use(self._name, file or "", True, time.perf_counter() - self._started_s[sig]))
        elif _KEPT_ONLY.get():
            raise NotKeptError(self._name, can_be_kept=file is not None)
        elif jit.watch is not None:
            reached = kernel_cache.reach(self._kernel.py_func, lambda value: isinstance(value, Kernel)).code
            names = {" ".join(line.split()[:2]) for line in reached.splitlines()}
            jit.watch.begin(self._name, len(names - _COMPILED))
        return result

    def save_overload(self, sig: Any, data: CompileResult) -> None:
        """Keep a compiled kernel, if it can be kept."""
        file = self._files.get(sig)
        USES.append(Use(self._name, file or "", False, time.perf_counter() - self._started_s[sig]))
        if file and not data.library.has_dynamic_globals and all(lifted.can_cache for lifted in data.lifted):
            STORE.save(file, dumps(data._reduce()))
