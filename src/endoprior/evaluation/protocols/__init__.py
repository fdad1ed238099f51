"""The evaluation scripts of other papers: `table` describes them, without torch, `compute` scores by them."""
