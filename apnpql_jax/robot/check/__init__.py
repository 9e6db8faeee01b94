"""What `apnpql robot check` reads, tries and shows; nothing moves."""
