"""Tables and plots of docs/performance.md."""
