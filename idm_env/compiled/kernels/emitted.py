"""Printed loops as instructions, one for each operation in the text, without numba's analysis of the whole.

What a step or a task says is printed as loops over arrays at addresses: assignments, operations, calls, nothing else.
numba's analysis of such a text takes a time that grows faster than its length: seven seconds for 300 lines. Here its
text is walked once. Every operation is numba's own, by its types, so its rounding is; a name has one type at a time.

Where a file has a number of ``LANES``, a subscript that leaves the last dimension out is a row: that many numbers, one
beside another in a register, and everything that meets one becomes a row. Functions are called lane by lane.
"""

from __future__ import annotations

import ast
import builtins
import operator
import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from idm_env import compat
from idm_env.compiled.kernels.compiler import STORE, counted, module_text, name_of
from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import ir
    from numba import carray, types  # type: ignore[attr-defined]
    from numba.core import cgutils
    from numba.core.typing.templates import signature
    from numba.np.arrayobj import populate_array
    from numba.np.numpy_support import from_dtype

from idm_env.compiled.kernels import functions
from idm_env.compiled.kernels.memory import located

_BYTE, _WHOLE = ir.IntType(8), ir.IntType(64)
_OPERATORS: dict[type[ast.AST], Any] = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}
_OPERATORS |= {ast.Div: operator.truediv, ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow}
_OPERATORS |= {ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge}
_OPERATORS |= {ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.USub: operator.neg, ast.Not: operator.not_}
_OPERATORS |= {ast.And: operator.and_, ast.Or: operator.or_}
_CONSTANT = re.compile(r"c|t\d+")
"""Names of arrays of constants."""
_OF_ROWS: dict[Any, str] = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_OF_ROWS |= {operator.neg: "fneg", operator.and_: "and_", operator.or_: "or_", operator.not_: "not_"}
_TESTS: dict[Any, str] = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}
_TESTS |= {operator.eq: "==", operator.ne: "!="}
_INTRINSIC: dict[Any, str] = {np.sqrt: "sqrt", abs: "fabs", np.floor: "floor"}
"""Operations on rows, as LLVM has them."""
_PLAIN = {bool: types.boolean, int: types.int64, float: types.float64}
_IN_LINE = {  # such that a NaN in x stays one
    "larger": ast.parse("y if x < y else x", mode="eval").body,
    "smaller": ast.parse("y if x > y else x", mode="eval").body,
    "min": ast.parse("y if y < x else x", mode="eval").body,
}


class Value(NamedTuple):
    """A number of the compiled code, with its type in numba."""

    kind: Any
    ir: Any


class Pointer(NamedTuple):
    """Numbers that lie one behind another in memory, of one type; ``name`` is that of what overlaps nothing else."""

    kind: Any
    ir: Any
    name: str = ""


class Variable(NamedTuple):
    """Where the numbers of a name lie while they have one type."""

    kind: Any
    slot: Any


class Walk:
    """One printed function, walked: ``run`` emits the instructions of all its statements."""

    def __init__(self, context: Any, builder: Any, room: dict[str, Any]) -> None:
        self._context, self._builder, self._room = context, builder, room
        self._names: dict[str, Any] = {}
        self._slots: dict[tuple[str, Any], Any] = {}
        self._calls: dict[Any, tuple[Any, Callable[..., Any]]] = {}
        self._taken: list[Any] = []
        self._read: list[tuple[str, Variable]] = []
        self._scopes: dict[str, Any] = {}
        self._accesses: list[tuple[Any, str]] = []
        self._lanes: int = room.get("LANES", 0)

    def run(self, function: ast.FunctionDef, arguments: Sequence[tuple[Any, Any]]) -> None:
        """Emit a function whose arguments have these types and values."""
        for parameter, (kind, value) in zip(function.args.args, arguments, strict=True):
            is_pointer = isinstance(kind, types.CPointer)
            self._names[parameter.arg] = Pointer(kind.dtype, value) if is_pointer else Value(kind, value)
        self._block(function.body)
        for access, name in self._accesses:
            others = [x for n, x in self._scopes.items() if n != name]
            if others:
                access.set_metadata("noalias", self._builder.module.add_metadata(others))
        for memory in self._taken:
            self._builder.call(self._outside("free", ir.VoidType(), _BYTE.as_pointer()), [memory])

    # -- statements ------------------------------------------------------------------------------------------------

    def _block(self, statements: Sequence[ast.stmt]) -> None:
        for each in statements:
            getattr(self, f"_{type(each).__name__.lower()}")(each)

    def _expr(self, node: ast.Expr) -> None:
        """Nothing for a docstring; a call for what it does."""
        if not isinstance(node.value, ast.Constant):
            self._value(node.value)

    def _pass(self, node: ast.Pass) -> None:
        """Nothing."""

    def _assign(self, node: ast.Assign) -> None:
        (target,) = node.targets
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            for name, value in zip(target.elts, node.value.elts, strict=True):
                self._set(name, self._value(value))
        else:
            self._set(target, self._value(node.value))

    def _augassign(self, node: ast.AugAssign) -> None:
        read = ast.copy_location(ast.BinOp(node.target, node.op, node.value), node)
        self._set(node.target, self._value(read))

    def _set(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Subscript):
            to = self._place(target)
            if isinstance(to.ir.type.pointee, ir.VectorType):
                self._builder.store(self._rows(value)[0].ir, to.ir, align=8)
                return
            content = self._context.data_model_manager[to.kind].as_data(self._builder, self._cast(value, to.kind))
            self._apart(self._builder.store(content, to.ir), to.name)
            return
        assert isinstance(target, ast.Name)
        if isinstance(value, Pointer):
            has_name = value.name or _CONSTANT.fullmatch(target.id)
            self._names[target.id] = value._replace(name=target.id if has_name else "given")
            return
        value = self._rows(value)[0] if self._lanes else self._number(value)
        slot = self._slots.get((target.id, value.kind))
        if slot is None:
            slot = cgutils.alloca_once(self._builder, value.ir.type, name=target.id)
            self._slots[target.id, value.kind] = slot
        self._builder.store(value.ir, slot)
        self._names[target.id] = Variable(value.kind, slot)

    def _for(self, node: ast.For) -> None:
        assert isinstance(node.target, ast.Name) and isinstance(node.iter, ast.Call)
        ends = [self._cast(self._value(x), types.int64) for x in node.iter.args]
        begin, end = ends[:2] if len(ends) > 1 else (_WHOLE(0), ends[0])
        by = ends[2] if len(ends) > 2 else _WHOLE(1)
        builder = self._builder
        head, body, out = (builder.append_basic_block(n) for n in ("for", "body", "out"))
        before = builder.block
        builder.branch(head)
        builder.position_at_end(head)
        index = builder.phi(_WHOLE, node.target.id)
        index.add_incoming(begin, before)
        builder.cbranch(builder.icmp_signed("<", index, end), body, out)
        builder.position_at_end(body)
        self._again(node.body, {node.target.id: Value(types.int64, index)})
        index.add_incoming(builder.add(index, by, flags=("nsw",)), builder.block)
        builder.branch(head)
        builder.position_at_end(out)

    def _while(self, node: ast.While) -> None:
        builder = self._builder
        head, body, out = (builder.append_basic_block(n) for n in ("while", "body", "out"))
        builder.branch(head)
        builder.position_at_end(head)
        builder.cbranch(self._condition(node.test), body, out)
        builder.position_at_end(body)
        self._again(node.body, {})
        builder.branch(head)
        builder.position_at_end(out)

    def _if(self, node: ast.If) -> None:
        with self._builder.if_then(self._condition(node.test)):
            self._again(node.body, {})

    def _again(self, statements: Sequence[ast.stmt], own: dict[str, Any]) -> None:
        """Emit what may run never or often; what gets another type in it is not known after it."""
        before, since = dict(self._names), len(self._read)
        self._names |= own
        self._block(statements)
        other = {n for n, x in before.items() if n not in own and self._names.get(n) != x}
        if another := [n for n in other if (n, before[n]) in self._read[since:]]:
            raise TypeError(f"{another[0]} changes its type within a loop")
        self._names = {n: x for n, x in before.items() if n not in other}

    # -- values ----------------------------------------------------------------------------------------------------

    def _value(self, node: ast.expr) -> Any:
        """Return a ``Value``, a ``Pointer``, or what Python knows already."""
        return getattr(self, f"_{type(node).__name__.lower()}")(node)

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        content = self._names.get(node.id)
        if isinstance(content, Variable):
            self._read.append((node.id, content))
            return Value(content.kind, self._builder.load(content.slot))
        if content is not None:
            return content
        return self._room[node.id] if node.id in self._room else getattr(builtins, node.id)

    def _attribute(self, node: ast.Attribute) -> Any:
        return getattr(self._value(node.value), node.attr)

    def _subscript(self, node: ast.Subscript) -> Value:
        place = self._place(node)
        if isinstance(place.ir.type.pointee, ir.VectorType):
            return Value(place.kind, self._builder.load(place.ir, align=8))
        content = self._builder.load(place.ir)
        self._apart(content, place.name)
        return Value(place.kind, self._context.data_model_manager[place.kind].from_data(self._builder, content))

    def _apart(self, access: Any, name: str) -> None:
        """Note where an access is to: own memory and constants lie apart from each other and from what is given.

        So LLVM need not test dozens of arrays for overlap, which it refuses to do, and then emits scalar code.
        """
        if name:
            add, scopes = self._builder.module.add_metadata, self._scopes
            scopes.setdefault(name, add([f"idm_env {name}", add(["idm_env"])]))
            access.set_metadata("alias.scope", add([scopes[name]]))
            self._accesses.append((access, name))

    def _place(self, node: ast.Subscript) -> Pointer:
        array, cell = self._value(node.value), node.slice
        *rows, index = (self._cast(self._value(x), types.int64) for x in getattr(cell, "elts", [cell]))
        if isinstance(array, Value):
            held = self._context.make_array(array.kind)(self._context, self._builder, array.ir)
            for row in rows:
                wide = cgutils.unpack_tuple(self._builder, held.shape, array.kind.ndim)[1]
                index = self._builder.add(self._builder.mul(row, wide), index)
            if self._lanes and len(rows) + 2 == array.kind.ndim:
                first = self._builder.gep(held.data, [self._builder.mul(index, _WHOLE(self._lanes))])
                row_type = ir.VectorType(held.data.type.pointee, self._lanes)
                return Pointer(array.kind.dtype, self._builder.bitcast(first, row_type.as_pointer()))
            array = Pointer(array.kind.dtype, held.data)
        return Pointer(array.kind, self._builder.gep(array.ir, [index]), array.name)

    def _binop(self, node: ast.BinOp) -> Any:
        return self._called(_OPERATORS[type(node.op)], [self._value(node.left), self._value(node.right)])

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        return self._called(_OPERATORS[type(node.op)], [self._value(node.operand)])

    def _compare(self, node: ast.Compare) -> Any:
        return self._called(_OPERATORS[type(node.ops[0])], [self._value(node.left), self._value(node.comparators[0])])

    def _boolop(self, node: ast.BoolOp) -> Any:
        result = self._value(node.values[0])
        for each in node.values[1:]:
            result = self._called(_OPERATORS[type(node.op)], [result, self._value(each)])
        return result

    def _ifexp(self, node: ast.IfExp) -> Any:
        test = self._value(node.test)
        if not isinstance(test, Value):
            return self._value(node.body if test else node.orelse)
        one, other = self._number(self._value(node.body)), self._number(self._value(node.orelse))
        if any(map(_is_row, (test, one, other))):
            (choice,), (one, other) = self._rows(test), self._rows(one, other)
            return Value(one.kind, self._builder.select(choice.ir, one.ir, other.ir))
        kind = self._context.typing_context.unify_types(one.kind, other.kind)
        chosen = self._builder.select(self._cast(test, types.boolean), self._cast(one, kind), self._cast(other, kind))
        return Value(kind, chosen)

    def _call(self, node: ast.Call) -> Any:
        if isinstance(node.func, ast.Name) and node.func.id in _IN_LINE:
            before = dict(self._names)
            self._names |= {n: self._value(x) for n, x in zip("xy", node.args, strict=True)}
            result = self._value(_IN_LINE[node.func.id])
            self._names = before
            return result
        called, arguments = self._value(node.func), [self._value(x) for x in node.args]
        if called is carray:
            return arguments[0]
        if called is located:
            kind = _type_of(arguments[1])
            to = self._context.get_data_type(kind).as_pointer()
            return Pointer(kind, self._builder.inttoptr(self._cast(arguments[0], types.int64), to))
        if called is np.empty:
            return self._room_for(arguments[0], _type_of(arguments[1] if len(arguments) > 1 else np.float64))
        if called is np.uint64:
            return arguments[0]  # of an index: none is negative
        if isinstance(called, type) and issubclass(called, np.generic):
            return Value(_type_of(called), self._cast(arguments[0], _type_of(called)))
        return self._called(called, arguments)

    def _called(self, function: Any, arguments: Sequence[Any]) -> Any:
        """Return what a function makes of numbers: numba's instructions for their types."""
        if not any(isinstance(x, (Value, Pointer)) for x in arguments):
            return function(*arguments)
        if any(map(_is_row, arguments)):
            return self._of_rows(function, arguments)
        numbers = [self._array(x) if isinstance(x, Pointer) else self._number(x) for x in arguments]
        kinds = tuple(x.kind for x in numbers)
        if (function, kinds) not in self._calls:
            kind = self._context.typing_context.resolve_value_type(function)
            call = kind.get_call_type(self._context.typing_context, kinds, {})
            self._calls[function, kinds] = call, self._context.get_function(kind, call)
        call, implementation = self._calls[function, kinds]
        values = [self._cast(x, kind) for x, kind in zip(numbers, call.args, strict=True)]
        for library in getattr(implementation, "libs", ()):
            self._context.active_code_library.add_linking_library(library)
        return Value(call.return_type, implementation(self._builder, values))

    def _of_rows(self, function: Any, arguments: Sequence[Any]) -> Value:
        """Return a function of rows: one instruction, its own lines on rows, or itself lane by lane."""
        if getattr(function, "__module__", "") == functions.__name__:
            return self._in_rows(function, arguments)
        if not any(function in table for table in (_OF_ROWS, _TESTS, _INTRINSIC)):
            return self._lane_by_lane(function, arguments)
        builder, rows = self._builder, self._rows(*arguments)
        kind, operands = rows[0].kind, [x.ir for x in rows]
        if function in _TESTS:
            unlike = builder.fcmp_unordered if function is operator.ne else builder.fcmp_ordered
            test = builder.icmp_signed if kind == types.int64 else unlike
            return Value(types.boolean, test(_TESTS[function], *operands))
        if function in _INTRINSIC:
            name = f"llvm.{_INTRINSIC[function]}.v{self._lanes}f64"
            return Value(kind, builder.call(self._outside(name, operands[0].type, operands[0].type), operands))
        name = _OF_ROWS[function]
        return Value(kind, getattr(builder, name[1:] if kind == types.int64 else name)(*operands))

    def _in_rows(self, function: Any, arguments: Sequence[Any]) -> Value:
        """Return one of ``functions`` of rows: its lines are walked here, its intrinsics take rows."""
        if not hasattr(function, "py_func"):
            (row,) = arguments
            kinds, emit = function._defn(self._context.typing_context, row.kind)
            return Value(row.kind, emit(self._context, self._builder, kinds, [row.ir]))
        lines, before = _functions(functions.__name__)[function.py_func.__name__], (self._names, self._room)
        self._names = {x.arg: y for x, y in zip(lines.args.args, arguments, strict=True)}
        self._room = function.py_func.__globals__
        self._block(lines.body[:-1])
        result = self._value(lines.body[-1].value)  # type: ignore[attr-defined]
        self._names, self._room = before
        return result

    def _lane_by_lane(self, function: Any, arguments: Sequence[Any]) -> Value:
        builder, each = self._builder, list(arguments)
        places = {i: cgutils.alloca_once_value(builder, x.ir) for i, x in enumerate(arguments) if _is_row(x)}
        with cgutils.for_range(builder, _WHOLE(self._lanes)) as loop:
            for i, place in places.items():
                first = builder.bitcast(place, each[i].ir.type.element.as_pointer())
                each[i] = Value(each[i].kind, builder.load(builder.gep(first, [loop.index])))
            one = self._called(function, each)
            result = cgutils.alloca_once(builder, ir.VectorType(one.ir.type, self._lanes))
            first = builder.bitcast(result, one.ir.type.as_pointer())
            builder.store(one.ir, builder.gep(first, [loop.index]))
        return Value(one.kind, builder.load(result))

    def _rows(self, *values: Any) -> list[Value]:
        """Return numbers as rows of one type: that of the first row among them."""
        numbers = [self._number(x) for x in values]
        kind = next((x.kind for x in numbers if _is_row(x)), types.float64)
        return [x if _is_row(x) else Value(kind, self._spread(self._cast(x, kind))) for x in numbers]

    def _spread(self, number: Any) -> Any:
        row = ir.VectorType(number.type, self._lanes)
        if isinstance(number, ir.Constant):
            return ir.Constant(row, [number] * self._lanes)
        first = self._builder.insert_element(ir.Constant(row, ir.Undefined), number, ir.IntType(32)(0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self._lanes), None)
        return self._builder.shuffle_vector(first, first, everywhere)

    def _array(self, pointer: Pointer) -> Value:
        """Return an array, longer than any, of what lies at a pointer."""
        kind = types.Array(pointer.kind, 1, "C")
        array = self._context.make_array(kind)(self._context, self._builder)
        item = self._context.get_abi_sizeof(pointer.ir.type.pointee)
        populate_array(array, pointer.ir, [_WHOLE(1 << 40)], [_WHOLE(item)], _WHOLE(item), None)
        return Value(kind, array._getvalue())

    def _number(self, value: Any) -> Value:
        if isinstance(value, Value):
            return value
        kind = _type_of(type(value)) if isinstance(value, np.generic) else _PLAIN[type(value)]
        return Value(kind, self._context.get_constant(kind, value))

    def _cast(self, value: Any, kind: Any) -> Any:
        content = self._number(value)
        return self._context.cast(self._builder, content.ir, content.kind, kind)

    def _condition(self, node: ast.expr) -> Any:
        return self._cast(self._value(node), types.boolean)

    def _room_for(self, count: int, kind: Any) -> Pointer:
        """Return fresh memory, which is given back at the end."""
        to = self._context.get_data_type(kind)
        size = ir.Constant(_WHOLE, count * self._context.get_abi_sizeof(to))
        memory = self._builder.call(self._outside("malloc", _BYTE.as_pointer(), _WHOLE), [size])
        self._taken.append(memory)
        return Pointer(kind, self._builder.bitcast(memory, to.as_pointer()), "own")

    def _outside(self, name: str, returned: Any, taken: Any) -> Any:
        return cgutils.get_or_insert_function(self._builder.module, ir.FunctionType(returned, [taken]), name)


def _type_of(kind: Any) -> Any:
    return from_dtype(np.dtype(kind))


def _is_row(value: Any) -> bool:
    return isinstance(value, Value) and isinstance(value.ir.type, ir.VectorType)


def inlined(function: Callable[..., Any]) -> Any:
    """Make a printed function one that loops of their file call, and that returns nothing.

    Arrays lie in one piece, of up to three dimensions.
    """
    return counted(function.__name__, ", ".join(_names(function)), _typed(function))


@lru_cache(maxsize=32)
def _functions(module: str) -> dict[str, ast.FunctionDef]:
    return {x.name: x for x in ast.parse(module_text(module)).body if isinstance(x, ast.FunctionDef)}


def _names(function: Callable[..., Any]) -> tuple[str, ...]:
    return function.__code__.co_varnames[: function.__code__.co_argcount]


def _typed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what gets the types of arguments of a printed function, and returns its signature and who emits it."""

    def typed(*given: Any) -> Any:
        def generate(context: Any, builder: Any, made: Any, arguments: Any) -> Any:
            walk = Walk(context, builder, function.__globals__)
            walk.run(_functions(function.__module__)[function.__name__], list(zip(made.args, arguments, strict=True)))
            return context.get_dummy_value()

        return signature(types.void, *given), generate

    return typed


def emitted(kind: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator of printed functions to be called by their ``address``; their machine code is kept."""

    def compiled(function: Callable[..., Any]) -> Any:
        parameters = ", ".join(_names(function))
        body = counted("body", parameters, _typed(function))
        room: dict[str, Any] = {"body": body, "__name__": function.__module__}
        exec(f"def {function.__name__}({parameters}):\n    body({parameters})", room)
        chosen = {"error_model": "numpy"} | options
        return compat.compiled_callback(room[function.__name__], kind, chosen, name_of(function, chosen), STORE)

    return compiled
