"""The action `apnpql robot check`: what it reads, tries and shows; nothing moves."""
