"""What people look at: one HTML page of a plan, a run or a calibration, and a recipe as a sheet for the bench.

In: files, read by `sources`; out: a page. `residuals` has what a plan and a calibration leave, `history` what a run
did; `tables` and `figures` show them, `page` and `certificate` put them in order; `template.html` prints sections.
"""
