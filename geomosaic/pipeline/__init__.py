"""Stage, parameters, registry, recipe, cache, executors, runner."""
