"""One module a method; each has `build(problem)`: `{task: function of nothing that does all the work}`."""
