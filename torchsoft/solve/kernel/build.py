"""Machine code of the kernels, made ahead: numba types them, LLVM compiles them once, all together.

    python -m torchsoft.solve.kernel.build [--level LEVEL ...] [--out DIR]

numba alone links every kernel into each of its callers and compiles it again there. Here it writes
unoptimised code only, which becomes one module that is compiled once. This module changes numba for
its process, so nothing else imports it.
"""

import argparse
import gc
import importlib
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from llvmlite import ir
from numba import types
from numba.core import codegen
from numba.core.cpu import CPUContext
from numba.core.datamodel import models
from numba.core.datamodel.registry import register_default
from numba.core.dispatcher import Dispatcher
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr
from numba.np.arrayobj import make_array, populate_array

from torchsoft.solve import kernel
from torchsoft.solve.kernel.objects import (
    ENTRIES,
    FOLDERS,
    LEVELS,
    NAME,
    alone,
    keep,
    level,
    read,
    remove_old,
)
from torchsoft.solve.kernel.table import layout

DATA = "kernels.data"

KNOWN = {"sin", "cos", "sqrt", "hypot", "pow"}
"""Functions of the mathematics library that kernels may call."""


class TableType(types.Type):
    """A table of one kind, whose value is its address."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind
        self.fields = {field.name: field for field in layout(kind)}
        super().__init__(f"Table({kind.__name__})")


@register_default(TableType)
class TableModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: TableType) -> None:
        super().__init__(manager, kind, ir.IntType(64))


def field_type(field: Any) -> Any:
    """numba's type of a field."""
    if field.ndim:
        return types.Array(numba.from_dtype(field.kind), field.ndim, "C")
    return {int: types.int64, float: types.float64}.get(field.kind) or TableType(field.kind)


@infer_getattr
class TableFields(AttributeTemplate):
    key = TableType

    def generic_resolve(self, table: TableType, name: str) -> Any:
        return field_type(table.fields[name])


@lower_getattr_generic(TableType)
def get_field(context: Any, builder: Any, table: TableType, address: Any, name: str) -> Any:
    """Load a field. Tables stay as they are while a kernel runs, so loads may be moved."""
    field, kind = table.fields[name], field_type(table.fields[name])
    size = ir.IntType(64)
    invariant = builder.module.add_metadata([])

    def word(number: int, of: Any = size) -> Any:
        place = builder.add(address, ir.Constant(size, 8 * (field.word + number)))
        value = builder.load(builder.inttoptr(place, of.as_pointer()))
        value.set_metadata("invariant.load", invariant)
        return value

    if not field.ndim:
        return word(0, ir.DoubleType() if field.kind is float else size)
    array = make_array(kind)(context, builder)
    shape = [word(1 + i) for i in range(field.ndim)]
    strides = [ir.Constant(size, 8)]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(word(0), context.get_data_type(kind.dtype).as_pointer())
    populate_array(array, data, shape, strides, ir.Constant(size, 8), meminfo=None)
    return array._getvalue()


OPTIONS: dict[str, Any] = {
    "nogil": True, "_nrt": False, "error_model": "numpy", "fastmath": {"contract", "reassoc"},
    "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip
"""Options of numba for kernels: nothing is allocated, counted or called from Python."""


def placeless(function: Any) -> Any:
    """The function without its file's folder, which numba would write into the code."""
    name = Path(function.__code__.co_filename).name
    function.__code__ = function.__code__.replace(co_filename=name)
    return function


def finalize(self: Any) -> None:
    """In place of numba's: leave the code as it is."""
    self._finalized = True


def whole_module() -> llvm.ModuleRef:
    """The unoptimised code of all entries and of what they call. An entry is a void(void*, void*,
    table's address) in it, every other function is internal."""
    # llvmlite's memory manager has room for the table of outside functions only beside other data
    whole = llvm.parse_assembly(f"@{DATA} = global i64 1")
    entries, linked, todo = dict[str, str](), set[Any](), list[Any]()
    for name, (module, kind) in ENTRIES.items():
        dispatcher = getattr(importlib.import_module(module), name)
        dispatcher.compile((TableType(kind),))
        (result,) = dispatcher.overloads.values()
        entries[result.fndesc.llvm_func_name] = name
        todo.append(result.library)
    whole.data_layout = str(todo[0]._final_module.data_layout)
    while todo:
        if (library := todo.pop()) not in linked:
            linked.add(library)
            todo += library._linking_libraries
            whole.link_in(library._final_module, preserve=True)
    for number, inside in enumerate([*whole.functions, *whole.global_variables]):
        if inside.name in entries:
            inside.name = entries[inside.name]
        elif not inside.is_declaration and inside.name != DATA:
            # numba's names count what was compiled before
            inside.name, inside.linkage = f"kernel.{number}", "internal"
    whole.verify()
    return whole


def compiled_object(module: str, target: str) -> bytes:
    """The object file of a module for a level of processors."""
    triple, cpu, features = LEVELS[target]
    parsed = llvm.parse_assembly(module)
    parsed.triple = triple
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu=cpu, features=features, opt=3, reloc="pic", codemodel="small"
    )
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization = options.slp_vectorization = True
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(parsed, passes)
    outside = {f.name for f in parsed.functions if f.is_declaration and f.name[:5] != "llvm."}
    if outside - KNOWN:
        raise ValueError(f"a kernel needs {sorted(outside - KNOWN)}, which no library has")
    return machine.emit_object(parsed)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--level", action="append", choices=LEVELS)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    gc.disable()  # of a short process, a sixth of whose time it would take
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    library: Any = codegen.CPUCodeLibrary
    context: Any = CPUContext
    dispatcher: Any = Dispatcher
    template = dispatcher.get_call_template
    library.finalize = finalize
    context.get_executable = lambda *_: [].append  # a new object each time, which nobody calls
    # a kernel is not compiled anew for a constant argument
    dispatcher.get_call_template = lambda self, args, keywords: template(
        self, tuple(map(types.unliteral, args)), keywords
    )
    kernel.compiled = lambda function: numba.njit(**OPTIONS)(placeless(function))
    if asked.out is None:
        remove_old()
    with alone() if asked.out is None else nullcontext():
        make(asked.level or [level()], asked.out)


def make(targets: list[str], out: Path | None) -> None:
    """Compile the kernels for levels of processors, into a folder `out`, or into that of the
    kernels where they are missing."""
    if out is None:
        targets = [one for one in targets if read(FOLDERS[0] / f"{one}.o") is None]
    if not targets:
        return
    start, module = time.perf_counter(), str(whole_module())
    for target in targets:
        content = compiled_object(module, target)
        if out is None:
            keep(target, content)
        else:
            (out / NAME).mkdir(exist_ok=True)
            (out / NAME / f"{target}.o").write_bytes(content)
    print(f"kernels: {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
