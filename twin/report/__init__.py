"""Readable results: pages, tables, charts, and pictures of the skin, the pins and their graphs.

Every command's page is a `twin.report.page.Page`: the command gives content, this package gives the look, in a light and a dark theme.
"""
