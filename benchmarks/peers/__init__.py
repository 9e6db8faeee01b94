"""Speed of the project relative to other libraries."""
