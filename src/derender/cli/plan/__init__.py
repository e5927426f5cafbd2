"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored.

settings: the plan file; sweep: all jobs, their notes, workers and budget; jobs: what each of them does;
outcome: tables, charts, and what is missing.
"""
