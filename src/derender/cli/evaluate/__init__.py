"""`derender evaluate`: one protocol a command, each beside its controls."""
