"""The evaluation scripts of other papers: `table` describes them, `compute` scores by them, `tags` compares them.

Nothing is imported here: `table` alone needs no torch.
"""
