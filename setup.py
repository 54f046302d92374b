# SPDX-License-Identifier: Apache-2.0
"""The one thing pyproject.toml cannot say: which script describes the C core to cffi."""

from setuptools import setup

setup(cffi_modules=["host_sdk/sparsegaze/_core_build.py:ffibuilder"])
