# Train an agent, show its table, play its policy on a simulated plant, identify from the record.
# Needs the extra: pip install 'excite[ppo]'
# After a minute of training the policy is far worse than the chirp in its table.
here=$(dirname "$0")
excite study run "$here/first_agent.toml" --out first_agent
excite study table first_agent
excite simulate aero2 --excitation first_agent/seeds/RL_all/0/policy.safetensors --out learned.csv --overwrite
excite identify learned.csv --plant aero2
