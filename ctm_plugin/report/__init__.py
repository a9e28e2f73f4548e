"""Reports: tables and pages that compare finished runs, in the form of the paper's tables."""
