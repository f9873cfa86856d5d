"""A text of any format from a template in the language of Jinja, whose sandbox reaches nothing but the values."""

from collections.abc import Mapping
from typing import Any

from gradcal_jax import units


def rendered(template: str, values: Mapping[str, Any]) -> str:
    """The template's text, with `values` by name and the filter `unit`: a number in SI in another unit. Names that have
    no value are errors. Errors: `ValueError` that says where."""
    # Imported where it is used: few commands fill in a template.
    from jinja2 import StrictUndefined, TemplateError, TemplateSyntaxError
    from jinja2.sandbox import ImmutableSandboxedEnvironment

    environment: Any = ImmutableSandboxedEnvironment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, autoescape=False
    )
    environment.filters["unit"] = units.to_unit
    try:
        return environment.from_string(template).render(values)
    except TemplateSyntaxError as problem:
        raise ValueError(f"the template, line {problem.lineno}: {problem.message}") from None
    except (TemplateError, units.UnitError, TypeError, ArithmeticError, LookupError) as problem:
        known = ", ".join(sorted(values))
        raise ValueError(f"the template: {problem}; the template can use the names {known}") from None
