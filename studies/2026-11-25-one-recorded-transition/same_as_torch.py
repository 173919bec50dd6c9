import sys,warnings,time
import numpy as np, torch; torch.set_num_threads(1)
import gymnasium as gym, idm_env
from idm_env.envs.vector import DiffIDMVectorEnv
warnings.simplefilter("error")
def run(task, kw, comp, steps=12, n=5):
    e=DiffIDMVectorEnv(n,task=task,output="torch",dtype="float64",**kw)
    if not comp: e.batch._values=None
    e.params={k:{p:x.clone().requires_grad_(True) for p,x in o.items()} for k,o in e.params.items()}
    o,_=e.reset(seed=3)
    g=torch.Generator().manual_seed(0)
    acts=[]; tot=0.; seen=[]
    for t in range(steps):
        a=(torch.rand(n,*e.single_action_space.shape,generator=g,dtype=torch.float64)*2-1).requires_grad_()
        acts.append(a)
        o,r,te,tr,i=e.step(a)
        seen.append(o.detach()); tot=tot+(o*torch.linspace(0.5,1,o.numel(),dtype=o.dtype).view_as(o)).sum()+r.sum()
    ps=[(k,p,x) for k,oo in e.params.items() for p,x in oo.items()]
    gr=torch.autograd.grad(tot,[*acts,*(x for *_,x in ps)],allow_unused=True)
    return seen, gr[:steps], {f"{k}.{p}":z for (k,p,_),z in zip(ps,gr[steps:])}, e
for task,kw in [("ring",{"warmup":5}),("ring",{"warmup":5,"effects":["delay","memory"]}),("follow",{"max_episode_steps":7}),("platoon",{"controlled":2,"noise":0.1})]:
    t=time.process_time(); a=run(task,kw,True); c=time.process_time()-t; b=run(task,kw,False)
    assert a[3].batch._values is not None
    print(task,kw,"values", max((x-y).abs().max().item() for x,y in zip(a[0],b[0])),"act grads",max((x-y).abs().max().item() for x,y in zip(a[1],b[1])),"par", {k:(None if v is None or b[2][k] is None else f"{((v-b[2][k]).abs()/(1e-9+b[2][k].abs())).item():.1e}") for k,v in a[2].items() if v is not None or b[2][k] is not None}, f"{c:.1f}s",flush=True)
