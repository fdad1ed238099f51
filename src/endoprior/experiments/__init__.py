"""Benchmarks: methods x sequences x budgets x seeds under one protocol, resumable, with intervals and plain verdicts.

`spec` says what, `matrix` keeps the books, `worker` does one cell, `execute` runs workers, `statistics` and `results`
compare, `tables`, `plots`, `pictures` and `report` show.
"""
