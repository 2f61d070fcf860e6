#!/bin/bash
# Measure everything that the tables compare, on CPUs: runs, then tables and charts, in build/campaign.
#
#   reports/measure_cpu.sh [--plan] [--small] [STEP...]     STEP: a table and a scene (A-room), or a table (A); default: all
#
# --plan prints the steps and their estimated hours, and starts nothing. --small takes every step in miniature, with the
# built-in scenes, in build/campaign-small. The same command resumes after an interruption: finished runs are skipped.
# Nothing is mixed: all steps have one commit, and a step has one sitting, on one machine. What must not be gone on with is
# refused. JOBS runs at a time (2) have one thread each; DATA is the folder of the scenes (data); BIN that of padgs-run
# (.venv/bin).
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-.venv/bin} data=${DATA:-data} jobs=${JOBS:-2} out=build/campaign dry="" small=""

described=omnigs,odgs,op43dgs,spags,spags_sorted,spags_tuned,padgs,padgs_unmodulated,padgs_plus
released=omnigs_release,odgs_release,op43dgs_release,padgs_release
six=bedroom,room,flat,basement,plaza,court

# Table, scenes, runs of a scene, seconds of a run on one core (of the runs in reports/measured), settings of padgs-run
plan() {
  cat <<END
A $six 33 240 +experiment=all_methods ~scene_set train.iterations=3000 data.width=256 seed=0,1,2 method=$described,spags_supersampled,padgs_plus_one_sample
A $six 5 570 +experiment=all_methods ~scene_set train.iterations=3000 data.width=256 seed=0 method=$released,egonerf_small
C $six 30 90 +experiment=equal_time budget.seconds=60 budget.clock=cpu data.width=512 seed=0,1,2 method=$described,spags_supersampled
L bedroom,basement,plaza 18 330 +experiment=equal_time budget.seconds=300 budget.clock=cpu data.width=512 seed=0,1,2 method=omnigs,spags,spags_tuned,spags_supersampled,padgs,padgs_plus
D bedroom,basement,court 12 350 +experiment=ablation train.iterations=3000 data.width=256 seed=0,1,2
D bedroom,basement,court 21 350 +experiment=ladder train.iterations=3000 data.width=256 seed=0,1,2
D bedroom,basement,court 12 270 +experiment=modulation protocol=both train.iterations=3000 data.width=256 seed=0,1,2
E bedroom,court 6 220 +sweep=tau train.iterations=1500 data.width=256 seed=0 method.tau=0,0.3,0.5,0.7,0.9,1
E bedroom,court 4 220 +sweep=lambda train.iterations=1500 data.width=256 seed=0 train.lambda_l1=0.2,0.6,0.8,1
E bedroom,court 4 220 +sweep=voxel_size train.iterations=1500 data.width=256 seed=0 method.voxel_pixels=0.1,1,3,10
F bedroom,room,basement 21 300 +experiment=all_methods ~scene_set train.iterations=3000 data.width=256 seed=0,1,2 smallest=on method=omnigs,odgs,op43dgs,spags_sorted,spags_tuned,padgs,padgs_plus
F bedroom,room,basement 105 100 +experiment=capacity train.iterations=1500 data.width=256 seed=0,1,2
G builtin 95 110 +experiment=stress train.iterations=1500 data.width=256 seed=0 stress.level=2 method=omnigs,op43dgs,spags_tuned,padgs,padgs_plus
G builtin 40 270 +experiment=stress train.iterations=1500 data.width=256 seed=0 stress.level=2 method=$released stress.condition=none,world_rotation,seam,pitch,world_scale,few_points,pose_noise,few_views,exposure,noise
J bedroom,flat,basement,court 46 50 +experiment=plus_ablation train.iterations=1000 data.width=256 seed=0,1
END
}

# Print the settings of a scene.
scene() {
  local views=16
  if [ "$1" = court ] && [ -z "$small" ]; then views=40; fi
  case $1 in
    court) echo "+scene=synthetic_outdoor data.generator.path=cross data.generator.path_radius=0.5 data.generator.train_views=$views" ;;
    builtin) echo "+scene=synthetic_room data.generator.train_views=$views data.generator.test_views=4 data.generator.points=8000" ;;
    *) echo "data.path=$data/$1" ;;
  esac
}

# Print what is done: STEP RUNS SECONDS SETTINGS, a line for each call of padgs-run.
commands() {
  local table scenes runs seconds settings name
  plan | while read -r table scenes runs seconds settings; do
    if [ -n "$small" ]; then
      case $settings in *seed=0,1,2*) runs=$((runs / 3)) ;; *seed=0,1*) runs=$((runs / 2)) ;; esac
      settings=$(sed -E 's/seed=[0-9,]+/seed=0/; s/data.width=[0-9]+/data.width=64/; s/train.iterations=[0-9]+/train.iterations=30/
        s/budget.seconds=[0-9]+/budget.seconds=1/' <<<"$settings")
      seconds=4
      case $scenes in *court*) scenes=builtin,court ;; *) scenes=builtin ;; esac
    fi
    for name in ${scenes//,/ }; do echo "$table-$name $runs $seconds $settings $(scene "$name")"; done
  done
}

hours() { awk -v s="$1" -v n="$jobs" 'BEGIN { printf "%.1f", s / n / 3600 }'; }

# Commit, processor and start of the machine: where and when a step is measured.
sitting() { echo "$(git rev-parse HEAD), $(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1), $(cat /proc/sys/kernel/random/boot_id)"; }

refuse() { echo "error: $*" >&2; exit 1; }

# End the runs of a step, which write checkpoints, then this script.
stop() {
  trap '' INT TERM HUP
  kill -s TERM -- "-$worker" || true
  wait "$worker" || true
  echo "stopped; the same command resumes" >&2
  exit 130
}

# Take a step; return 0 if every run of it has a result.
take() {
  local step=$1 run settings
  [ -e "$out/$step.sitting" ] || sitting >"$out/$step.sitting"
  trap : TERM  # wait for the runs, which end with checkpoints
  commands | while read -r name _ _ settings; do
    trap : TERM
    if [ "$name" != "$step" ]; then continue; fi
    # shellcheck disable=SC2086
    run=($bin/padgs-run -m $settings run.folder=$out/runs run.threads=1 tracking=none)
    if [ "$jobs" != 1 ]; then run+=(launcher=local run.jobs="$jobs"); fi
    echo "${run[*]}" >>"$out/$step.log"
    status=0
    "${run[@]}" 9>&- </dev/null 2>&1 | (trap '' INT TERM; exec tee -a "$out/$step.log" 9>&-) || status=$?
    if [ $status -gt 1 ]; then exit $status; fi
    # Status 1 is also that of a run which failed, which is a result.
    if grep ' done' "$out/$step.log" | tail -n 1 | grep -qE 'refused|crashed|killed|elsewhere|waiting|stopped'; then exit 1; fi
  done
}

steps=()
for argument; do
  case $argument in
    --plan) dry=yes ;;
    --small) small=yes out=build/campaign-small ;;
    -*) refuse "$argument is no option; see the head of $0" ;;
    *) steps+=("$argument") ;;
  esac
done
all=$(commands | awk '!seen[$1]++ { print $1 }')
chosen=""
for step in $all; do
  for wanted in "${steps[@]-$step}"; do
    case $step in "$wanted" | "$wanted"-*) chosen+=" $step" ;; esac
  done
done
for wanted in "${steps[@]-}"; do
  case " $chosen" in *" $wanted"*) ;; *) refuse "there is no step $wanted; known:" $all ;; esac
done

# The estimate, and the steps that are left.
left="" total=0
printf '%-14s %6s %9s\n' step runs hours
for step in $chosen; do
  read -r runs seconds < <(commands | awk -v s="$step" '$1 == s { n += $2; t += $2 * $3 } END { print n, t }')
  state=""
  if [ -e "$out/$step.done" ]; then state=done; else left+=" $step"; total=$((total + seconds)); fi
  printf '%-14s %6d %9s %s\n' "$step" "$runs" "$(hours $seconds)" $state
done
echo "left: $(wc -w <<<"$left") steps, about $(hours $total) h with $jobs runs at a time"
if [ -n "$dry" ]; then exit; fi

mkdir -p "$out/runs"
exec 9>"$out/lock"
flock -n 9 || refuse "$out is being measured by another process"
git diff --quiet HEAD || refuse "files differ from the commit, which then says nothing about the results; commit them"
commit=$(git rev-parse HEAD)
for file in "$out"/*.sitting; do
  if [ -e "$file" ] && [ "$(cut -d, -f1 "$file")" != "$commit" ]; then
    refuse "$(basename "$file" .sitting) was measured at commit $(cut -c1-10 "$file"), and this is ${commit:0:10}; \
check that out, or move $out away to measure everything again"
  fi
done

missing=""
for step in $left; do
  if [ -e "$out/$step.sitting" ] && [ "$(sitting)" != "$(cat "$out/$step.sitting")" ]; then
    echo "$step was begun in another sitting ($(cat "$out/$step.sitting")): remove its runs, which the command \
padgs-run in $out/$step.log lists, and $out/$step.sitting, to measure it again" >&2
    missing+=" $step"
    continue
  fi
  echo "$step: about $(hours $total) h left"
  set -m  # for a process group, to which a signal to this script alone is passed on
  take "$step" &
  worker=$!
  trap stop INT TERM HUP
  set +m
  status=0
  wait "$worker" || status=$?
  other=$(grep -L "\"commit\": \"$commit\"" "$out"/runs/*/result.json 2>/dev/null || true)
  if [ -n "$other" ]; then refuse "of another commit than ${commit:0:10}, remove them:" $(head -n 5 <<<"$other"); fi
  if [ $status -gt 1 ]; then echo "stopped; the same command resumes" >&2; exit $status; fi
  if [ $status = 0 ]; then touch "$out/$step.done"; else missing+=" $step"; fi
  total=$((total - $(commands | awk -v s="$step" '$1 == s { t += $2 * $3 } END { print t }')))
done
if [ -n "$missing" ]; then refuse "runs without a result in$missing: see $out/STEP.log; the same command tries again"; fi
"$bin/padgs" report all "$out/runs" --strict --collect --out "$out/measured"
