"""The deck's studies: experiments of the lecture that need no scene, each small enough to watch while it runs."""
