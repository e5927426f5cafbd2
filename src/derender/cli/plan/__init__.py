"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored.

settings: the plan file; jobs: what a job is, and does; sweep: all jobs, workers and budget; outcome: tables,
charts, and what is missing.
"""
