"""`derender compare --plan`: many methods on many data sets, trained, embedded and scored.

settings    what a plan file says
jobs        what has to be done, in which order, and where it lies
training    one training, or a run that is there already
embedding   one feature table
asking      one data set's scores: questions of every method at once
running     all jobs: worker processes, budget, what is there from before
outcome     tables, pictures and the account of what is missing
"""
