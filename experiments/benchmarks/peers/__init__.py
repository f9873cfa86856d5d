"""One module a method; each has `build(problem)`, which returns `{task: function of nothing that does all the work}`."""
