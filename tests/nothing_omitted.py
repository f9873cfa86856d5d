"""Specs that name every error term."""

from typing import Any

from gradcal_jax.spec.absent import absent_terms
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec


def zeros_of_omitted(spec: Spec) -> dict[str, Any]:
    """A zero for every term that the spec does not name, but for the direction of the Earth's rate, by its key."""

    def zero(value: Any) -> Any:
        if isinstance(value, str):
            return f"0 {value.split(' ', 1)[1]}"
        if isinstance(value, list):
            return []
        return value | {key: zero(value[key]) for key in ("prior", "standard_deviation") if key in value}

    return {term.key: zero(term.value) for term in absent_terms(spec) if term.value != "unknown"}


def with_nothing_omitted(spec: Spec) -> Spec:
    """The spec with all of them."""
    return changed(spec, zeros_of_omitted(spec))
