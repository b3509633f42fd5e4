# Everything a newcomer needs: `make demo`, `make test`. Only Python 3.11 or newer and make are expected.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
# Modules are compiled when they are first imported: of most packages few are.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt

# A process a core, but two at least and four at most: each needs up to 2 GB.
PROCESSES := $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$((n < 2 ? 2 : n > 4 ? 4 : n)))
PYTEST := $(BIN)/python -m pytest -n $(PROCESSES)
# Thousands of small programs are compiled in the tests and run once: compiling is most of their time.
# What `optimised` of tests/compiled.py decorates computes for longer. The flags are of the jaxlib in constraints.txt: without
# optimisation, its gradients of trainings are NaN where additions and multiplications are fused. AVX does not fuse.
QUICK := JAX_DISABLE_MOST_OPTIMIZATIONS=1 XLA_FLAGS="--xla_cpu_use_fusion_emitters=false --xla_cpu_max_isa=AVX \
    --xla_cpu_parallel_codegen_split_count=1"

# Without byte code each of hundreds of processes compiles thousands of files first: eight seconds of eleven.
units test-slow test-pages test-science check-results coverage: export PYTHONDONTWRITEBYTECODE :=
units test-slow test-pages test-science check-results coverage: export PYTHONPYCACHEPREFIX := $(CURDIR)/.venv/bytecode

.PHONY: help demo test units test-slow test-pages test-science test-all check-results coverage lint types docs results \
    agents policies certificates evaluations clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: .venv/core ## the baseline rows of the paper's Table 1, with three estimators, in runs/baselines
	$(BIN)/excite study run baselines --out runs/baselines --overwrite

# The type checker has one thread: the tests begin on the other core.
test: lint ## style, types, unit and command-line tests
	$(MAKE) --jobs=2 types units UNITS="$(UNITS)"

# The tests of a file share their compiled programs: one process runs the file.
units: .venv/dev ## unit and command-line tests
	$(QUICK) $(PYTEST) --dist loadfile $(UNITS)

test-slow: .venv/dev ## the unit and command-line tests that take more than about three seconds
	$(QUICK) $(PYTEST) --dist loadfile -m 'slow and not science'

# A test of the page waits for a browser and a server most of its time: one process more keeps the cores busy.
test-pages: .venv/dev ## commands of the documentation, and the bench page in a browser
	$(QUICK) $(PYTEST) -n $$(($(PROCESSES) + 1)) --dist worksteal tests/pages

test-science: .venv/dev ## promises of the shipped policies, baselines, trainings from end to end
	$(QUICK) $(PYTEST) --dist worksteal -m science

check-results: .venv/dev ## the committed results are what the documentation says of them
	$(PYTEST) --dist worksteal tests/results

# In one pass with the unit tests, the slow ones find compiled what they share with them.
test-all: UNITS := -m 'not science'
test-all: test test-pages test-science check-results ## all tests

coverage: .venv/dev ## lines of the package that no unit or command-line test runs
	$(QUICK) $(PYTEST) --dist loadfile -m 'not science' --cov=excite --cov-report=term-missing:skip-covered

lint: .venv/dev ## style
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev ## types
	$(BIN)/basedpyright --pythonpath $(BIN)/python

docs: .venv/dev ## this documentation as a site, in site/ (open site/index.html)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

results: .venv/core ## computes the committed results again (minutes in docs/reference/studies.md)
	for study in baselines nls nls_quantised decay damping damping_encoder damping_noise_free; do \
	  $(BIN)/excite study run $$study --out results/$$study --overwrite || exit 1; \
	done

agents: .venv/dev ## trains the agents of the studies again (hours; rerun to resume)
	for study in table1 paper frontier robust wide emps dc_motor cart_pole aero2_lag half amplitude nls_reward spread reward \
	    two_minutes sim_to_real oed_linear_pendulum oed_nonlinear_pendulum oed_cart_pole oed_double_pendulum \
	    oed_location_finding; do \
	  $(BIN)/excite study run $$study --out runs/$$study || exit 1; \
	done

policies: ## what is shipped in src/excite/policy/shipped, from the results of the studies (then: certificates)
	cp results/robust/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/aero2.safetensors
	cp results/frontier/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/aero2-ideal.safetensors
	cp results/wide/seeds/gradient_A/0/policy.safetensors src/excite/policy/shipped/aero2-wide.safetensors
	cp results/frontier/seeds/gradient_goals/0/policy.safetensors src/excite/policy/shipped/aero2-goals.safetensors
	cp results/robust/seeds/gradient_D_p/0/policy.safetensors src/excite/policy/shipped/aero2-damping.safetensors
	cp results/table1/seeds/RL_all/2/policy.safetensors src/excite/policy/shipped/aero2-ppo-all.safetensors
	cp results/table1/seeds/RL_J_p/7/policy.safetensors src/excite/policy/shipped/aero2-ppo-J_p.safetensors
	cp results/table1/seeds/RL_K_pu/7/policy.safetensors src/excite/policy/shipped/aero2-ppo-K_pu.safetensors
	cp results/table1/seeds/RL_D_p/5/policy.safetensors src/excite/policy/shipped/aero2-ppo-D_p.safetensors
	cp results/emps/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/emps.safetensors
	cp results/dc_motor/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/dc_motor.safetensors
	cp results/emps_wide/seeds/gradient_A/0/policy.safetensors src/excite/policy/shipped/emps-wide.safetensors
	cp results/dc_motor_wide/seeds/gradient_A/0/policy.safetensors src/excite/policy/shipped/dc_motor-wide.safetensors
	cp results/cart_pole_wide/seeds/gradient_A/0/policy.safetensors src/excite/policy/shipped/cart_pole-wide.safetensors
	cp results/aero2_lag/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/aero2_lag.safetensors
	cp results/cart_pole/seeds/gradient_D/0/policy.safetensors src/excite/policy/shipped/cart_pole.safetensors
	cp results/sim_to_real/seeds/gradient_robust/0/policy.safetensors src/excite/policy/shipped/aero2_detailed.safetensors

# Where the training declared no uncertainty, the initial state is within 2 % of its scale. Exit code 1 is a policy
# that is not safe: the certificate says so. Four have a guard for rigs, too; docs/reference/real-time.md says why.
certificates: .venv/core ## searches for the worst plant of each shipped policy; certificate (and guard) go into its file
	for file in $(wildcard src/excite/policy/shipped/*.safetensors); do \
	  case $$file in \
	    *-goals.*|*-ideal.*|*-ppo-*) declared="--uncertainty initial_state=2%" ;; \
	    *) declared= ;; \
	  esac; \
	  case $$file in \
	    */aero2.*|*/aero2_detailed.*|*/cart_pole.*) guard=--guard ;; \
	    */dc_motor.*) guard="--guard --budget 40000" ;; \
	    *) guard= ;; \
	  esac; \
	  $(BIN)/excite falsify $$file $$declared $$guard --certify $$file --overwrite || [ $$? = 1 ] || exit 1; \
	done

evaluations: .venv/core ## evaluates the shipped policies on new plants, in results/policies
	mkdir -p results/policies
	for policy in $(filter-out cart_pole %-wide aero2 aero2-ideal aero2-goals aero2-damping,$(notdir $(basename $(wildcard src/excite/policy/shipped/*.safetensors)))); do \
	  $(BIN)/excite evaluate $$policy --episodes 1000 --seed 7 --json > results/policies/$$policy.json || exit 1; \
	done
	$(BIN)/excite evaluate cart_pole --episodes 200 --seed 7 --json > results/policies/cart_pole.json
	$(BIN)/excite evaluate aero2-wide --spread factor:3 --coast 50 --episodes 1000 --seed 7 --json > results/policies/aero2-wide.json
	for policy in dc_motor-wide emps-wide; do \
	  $(BIN)/excite evaluate $$policy --spread factor:2 --coast 50 --episodes 1000 --seed 7 --json > results/policies/$$policy.json || exit 1; \
	done
	$(BIN)/excite evaluate cart_pole-wide --spread factor:2 --coast 50 --episodes 200 --seed 7 --json > results/policies/cart_pole-wide.json
	for policy in aero2 aero2-ideal aero2-goals aero2-damping; do \
	  $(BIN)/excite evaluate $$policy --episodes 10000 --seed 7 --json > results/policies/$$policy.json || exit 1; \
	done
	$(BIN)/excite evaluate aero2_detailed --rig --filter --episodes 10000 --seed 7 --json > results/policies/aero2_detailed_rig.json

.venv/core: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	$(PYTHON) -m venv .venv
	$(INSTALL) --editable .
	touch $@

.venv/dev: .venv/core
	$(INSTALL) --editable '.[dev,docs,ppo,dask,tune,fmu,onnx,logs,bayes,web]'
	touch $@

clean: ## removes the installation
	rm -rf .venv
