"""CPU µs a step of faces: min over turns. python faces.py WHICH..."""
import sys, time, warnings; warnings.simplefilter("ignore")
import numpy as np, torch; torch.set_num_threads(1)
import gymnasium as gym, idm_env
def best(f, k, turns=7):
    xs=[]
    for _ in range(turns):
        t=time.process_time()
        for _ in range(k): f()
        xs.append((time.process_time()-t)/k*1e6)
    xs.sort(); return xs[0], xs[len(xs)//2]
def say(n, x): print(f"{n:34s} {x[0]:9.1f} ({x[1]:9.1f}) us", flush=True)
which=set(sys.argv[1:])
def on(k): return not which or k in which
for task in ("ring","follow"):
    if on("single"):
        e=gym.make("DiffIDM-v0",task=task); e.reset(seed=0); a=np.zeros(1,np.float32)
        def f():
            *_,term,trunc,_=e.step(a)
            if term or trunc: e.reset()
        u=e.unwrapped
        f(); say(f"single {task} (wrapped)", best(f,300))
        def g():
            *_,term,trunc,_=u.step(a)
            if term or trunc: u.reset()
        e.reset(); say(f"single {task} (unwrapped)", best(g,300))
for n in (64,1024,4096):
    if on(f"vector{n}"):
        e=gym.make_vec("DiffIDM-v0",num_envs=n,task="ring"); e.reset(seed=0); a=np.zeros((n,1),np.float32)
        say(f"vector {n} ring", best(lambda: e.step(a), max(10,6000//n)))
def policy(w):
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(w,32),torch.nn.Tanh(),torch.nn.Linear(32,32),torch.nn.Tanh(),torch.nn.Linear(32,1),torch.nn.Tanh())
for n,steps in ((1,100),(64,100),(1024,50)):
    e=None
    for way in ("loop","unroll"):
        if on(f"{way}{n}"):
            e=gym.make_vec("DiffIDM-v0",num_envs=n,task="ring",output="torch",failsafe=3.0,max_command=0.02)
            p=policy(e.single_observation_space.shape[0])
            F=[];B=[]
            for turn in range(6):
                o,_=e.reset(seed=turn); t0=time.process_time()
                if way=="loop":
                    tot=0.
                    for _ in range(steps):
                        o,r,*_=e.step(p(o)); tot=tot+r.mean()
                else: tot=e.unwrapped.unroll(p,steps).reward.mean()
                t1=time.process_time(); tot.backward(); t2=time.process_time()
                if turn: F.append((t1-t0)/steps*1e6); B.append((t2-t0)/steps*1e6)
            F.sort();B.sort()
            say(f"{way} {n} forward",(F[0],F[2])); say(f"{way} {n} with gradient",(B[0],B[2]))
