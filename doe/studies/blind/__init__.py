"""The blind study: how often is the diagnosis right about effects that it cannot know?"""
