"""The master: plants (FMUs) and their controllers over a digraph, in communication steps."""
