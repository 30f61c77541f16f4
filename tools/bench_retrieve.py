#!/usr/bin/env python
"""tmp"""
