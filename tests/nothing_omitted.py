"""Specs that name every error term."""

from typing import Any

from gradcal_jax.files import changed
from gradcal_jax.files.spec.absent import absent_terms
from gradcal_jax.files.spec.spec_sections import Spec


def zeros_of_omitted(spec: Spec) -> dict[str, Any]:
    """A zero for every term that the spec does not name, but for the direction of the Earth's rate, by its key."""

    def zero(value: Any) -> Any:
        if isinstance(value, str):
            return f"0 {value.split(' ', 1)[1]}"
        return [] if isinstance(value, list) else value | {"standard_deviation": "0 K"}

    return {term.key: zero(term.value) for term in absent_terms(spec) if term.value != "unknown"}


def with_nothing_omitted(spec: Spec) -> Spec:
    """The spec with all of them."""
    return changed(spec, zeros_of_omitted(spec))
