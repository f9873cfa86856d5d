"""Numbers as pages write them."""


def figures(value: float, digits: int = 4) -> str:
    """A number with so many digits, as people write it: no powers of ten, a minus that is one."""
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    return text.replace("-", "−")
