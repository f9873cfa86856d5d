"""A text of any format from a template in the language of Jinja, without access to anything but the values.

Templates of users are limited, too, so that a file from somebody else takes neither time nor memory: no macros, no
joining of texts but by filters, and limits for loops, widths and lengths.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, Final

from gradcal_jax import units

_PASSES: Final = 10_000
_LONGEST_TEXT: Final = 100_000
_LONGEST: Final = 10_000_000
_WIDEST: Final = 100
_NUMBERS: Final = (int, float)
_FILTERS: Final = (
    "abs", "default", "first", "float", "format", "int", "join", "last", "length", "list", "lower", "map", "max", "min",
    "round", "string", "sum", "tojson", "unit", "upper",
)  # fmt: skip
_REFUSED_NODES: Final = (
    "Macro", "CallBlock", "Include", "Import", "FromImport", "Extends", "Block", "FilterBlock", "AssignBlock", "Concat",
)  # fmt: skip


def rendered(template: str, values: Mapping[str, Any], *, trusted: bool = True) -> str:
    """The template's text, with `values` by name and the filter `unit`: a number in SI in another unit. Names that have
    no value are errors, and nothing but the values can be reached. Errors: `ValueError` that says where."""
    # Imported where it is used: few commands fill in a template.
    from jinja2 import TemplateError, TemplateSyntaxError

    environment: Any = _environment(trusted=trusted)
    try:
        source = template if trusted else _checked(environment, template)
        return _joined(environment.from_string(source).generate(values))
    except TemplateSyntaxError as problem:
        raise ValueError(f"the template, line {problem.lineno}: {problem.message}") from None
    except (TemplateError, units.UnitError, TypeError, ArithmeticError, LookupError) as problem:
        known = ", ".join(sorted(values))
        raise ValueError(f"the template: {problem}; the template can use the names {known}") from None


def _joined(parts: Iterable[str]) -> str:
    text: list[str] = []
    length = 0
    for part in parts:
        length += len(part)
        if length > _LONGEST:
            raise ValueError(f"the template: its text has more than {_LONGEST} characters")
        text.append(part)
    return "".join(text)


def _environment(*, trusted: bool) -> object:
    from jinja2 import StrictUndefined
    from jinja2.sandbox import ImmutableSandboxedEnvironment

    class Limited(ImmutableSandboxedEnvironment):
        intercepted_binops = frozenset() if trusted else frozenset({"+", "*", "%", "**"})

        def is_safe_attribute(self, obj: Any, attr: str, value: Any) -> bool:
            of_text = isinstance(obj, (str, bytes, *_NUMBERS)) and not trusted
            return not of_text and super().is_safe_attribute(obj, attr, value)

        def wrap_str_format(self, value: Any) -> Any:
            return super().wrap_str_format(value) if trusted else None

        def call_binop(self, context: Any, operator: str, left: Any, right: Any) -> Any:
            if not isinstance(left, _NUMBERS) or not isinstance(right, _NUMBERS):
                raise TypeError(f"{operator} is for numbers")
            return super().call_binop(context, operator, float(left), float(right))

    environment = Limited(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, autoescape=False
    )
    known: dict[str, Any] = vars(environment)["filters"]
    known["unit"] = units.to_unit
    if not trusted:
        filters = {name: _limited(name, known[name]) for name in _FILTERS}
        vars(environment)["filters"] = filters | {"passes": partial(_passes, _Budget())}
        vars(environment)["globals"] = {"range": range}
    return environment


class _Budget:
    left = _PASSES


def _passes(budget: _Budget, items: Iterable[Any]) -> Iterator[Any]:
    for item in items:
        budget.left -= 1
        if budget.left < 0:
            raise ValueError(f"the template: its loops have more than {_PASSES} passes")
        yield item


def _limited(name: str, apply: Callable[..., Any]) -> Callable[..., Any]:
    """A filter whose arguments and results are of a limited size."""
    from functools import wraps

    @wraps(apply)
    def filtered(*arguments: Any, **options: Any) -> Any:
        for value in (*arguments, *options.values()):
            large = isinstance(value, int) and abs(value) > 2**64
            if large or (isinstance(value, range) and len(value) > _PASSES):
                raise TypeError(f"a number of the filter {name} is too large")
            if name in ("format", "round") and isinstance(value, str):
                _check_widths(value)
        digits = [value for value in arguments[1:] if not isinstance(value, str)]
        if name == "round" and any(abs(value) > _WIDEST for value in digits):
            raise TypeError(f"round to at most {_WIDEST} digits")
        result = apply(*arguments, **options)
        if isinstance(result, str) and len(result) > _LONGEST_TEXT:
            raise TypeError(f"the filter {name} makes a text of more than {_LONGEST_TEXT} characters")
        return result

    return filtered


def _check_widths(form: str) -> None:
    wide = any(int(digits[:9]) > _WIDEST for digits in re.findall(r"\d+", form))
    if wide or re.search(r"%[^%a-zA-Z]*\*", form):
        raise TypeError(f"widths and decimals of a format are at most {_WIDEST}")


def _checked(environment: Any, template: str) -> Any:
    """The template's tree, with counted loops. Raises `ValueError` for what only programs need."""
    from jinja2 import nodes

    tree = environment.parse(template)
    for name in _REFUSED_NODES:
        for node in tree.find_all(getattr(nodes, name)):
            raise ValueError(f"the template, line {node.lineno}: {name} is not allowed in a template of this program")
    for node in tree.find_all(nodes.Assign):
        if any(node.node.find_all((nodes.List, nodes.Tuple, nodes.Dict))) or isinstance(
            node.node, nodes.List | nodes.Tuple | nodes.Dict
        ):
            raise ValueError(f"the template, line {node.lineno}: set is for numbers and texts")
    for loop in list(tree.find_all(nodes.For)):
        if loop.recursive:
            raise ValueError(f"the template, line {loop.lineno}: recursive loops are not allowed")
        loop.iter = nodes.Filter(loop.iter, "passes", [], [], None, None, lineno=loop.lineno)
    return tree
