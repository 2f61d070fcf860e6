#!/bin/sh
# A Slurm of one node with two cores on this machine, for the trials of docs/cluster.md. Debian or Ubuntu, as root.
#   sh tests/cluster/slurm.sh start      installs slurm-wlm, munge, slurmdbd and MariaDB where they are missing
#   export SLURM_CONF=/tmp/padgs-slurm/slurm.conf
#   sh tests/cluster/slurm.sh stop
# Partition main is preempted by partition urgent. ACCOUNTING=no leaves slurmdbd out, so that sacct answers nothing;
# MAX_ARRAY=11 sets MaxArraySize.
set -eu
folder=${FOLDER:-/tmp/padgs-slurm}
export SLURM_CONF="$folder/slurm.conf"

stop() {
    for name in slurmd slurmctld slurmdbd; do
        [ ! -s "$folder/$name.pid" ] || kill "$(cat "$folder/$name.pid")" 2> /dev/null || true
    done
    sleep 2
}

install() {
    [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null || { echo "skipped: needs root and apt-get"; exit 77; }
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq slurm-wlm munge slurmdbd mariadb-server > /dev/null
}

configure() {
    mkdir -p "$folder/state" "$folder/spool" "$folder/log"
    cat > "$folder/slurmdbd.conf" << EOF
AuthType=auth/munge
DbdHost=localhost
SlurmUser=root
PidFile=$folder/slurmdbd.pid
LogFile=$folder/log/slurmdbd.log
StorageType=accounting_storage/mysql
StorageUser=slurm
StoragePass=slurm
EOF
    chmod 600 "$folder/slurmdbd.conf"
    storage="AccountingStorageType=accounting_storage/none"
    [ "${ACCOUNTING:-yes}" != yes ] || storage="AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=localhost
AccountingStorageEnforce=limits"
    cat > "$folder/slurm.conf" << EOF
ClusterName=padgs
SlurmctldHost=localhost(127.0.0.1)
SlurmUser=root
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/log/slurmctld.log
SlurmdLogFile=$folder/log/slurmd.log
$storage
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
KillWait=10
AuthInfo=cred_expire=20
SlurmdTimeout=15
MaxArraySize=${MAX_ARRAY:-1001}
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
NodeName=localhost NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000 State=UNKNOWN
PartitionName=main Nodes=localhost Default=YES MaxTime=INFINITE State=UP PriorityTier=1 PreemptMode=REQUEUE
PartitionName=urgent Nodes=localhost MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
EOF
}

start() {
    command -v slurmctld > /dev/null && command -v slurmdbd > /dev/null && command -v mariadbd > /dev/null || install
    configure
    munge -n > /dev/null 2>&1 || service munge start
    if [ "${ACCOUNTING:-yes}" = yes ]; then
        mysqladmin ping > /dev/null 2>&1 || service mariadb start
        mysql -e "create database if not exists slurm_acct_db;
            create user if not exists slurm@localhost identified by 'slurm'; grant all on slurm_acct_db.* to slurm@localhost"
        slurmdbd
        sleep 5
        sacctmgr -i add cluster padgs > /dev/null || true
        sacctmgr -i add account padgs > /dev/null || true
        sacctmgr -i add user root account=padgs > /dev/null || true
    fi
    slurmctld -f "$SLURM_CONF"
    slurmd -f "$SLURM_CONF" -N localhost
    for _ in 1 2 3 4 5 6 7 8 9 10; do sinfo -h -t idle | grep -q main && break; sleep 1; done
    sinfo --version && sinfo
}

case ${1:-} in
    start) stop; start ;;
    stop) stop ;;
    *) echo "usage: sh tests/cluster/slurm.sh start|stop" >&2; exit 1 ;;
esac
