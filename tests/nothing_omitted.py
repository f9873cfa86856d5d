"""Specs that name every error term."""

from typing import Any

from gradcal_jax.files import changed
from gradcal_jax.files.spec.absent import absent_terms
from gradcal_jax.files.spec.spec_sections import Spec


def with_nothing_omitted(spec: Spec) -> Spec:
    """The spec with a zero for every term that it does not name, but for the direction of the Earth's rate."""

    def zero(value: Any) -> Any:
        if isinstance(value, str):
            return f"0 {value.split(' ', 1)[1]}"
        return [] if isinstance(value, list) else value | {"standard_deviation": "0 K"}

    return changed(spec, {term.key: zero(term.value) for term in absent_terms(spec) if term.value != "unknown"})
