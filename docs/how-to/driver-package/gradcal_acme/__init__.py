"""Two drivers from outside: an ACME chamber, and ACME's unit, which sends frames."""
