"""Built-in pipelines, shipped as YAML files beside this module."""
