"""Finds the packages: pyproject.toml cannot say that folders beside src/ are packages within tactflow."""

from setuptools import find_packages, setup

setup(packages=[*find_packages("src"), "tactflow.stages", "tactflow.sinks", "tactflow.pipelines"])
